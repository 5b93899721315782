"""What open streams are told of jobs, for all of them in one query."""

from collections.abc import Collection
from datetime import datetime
from uuid import UUID

from sqlalchemy import or_, select
from sqlalchemy.ext.asyncio import AsyncSession

from app.domain.jobs import JobState
from app.domain.streams import JobNews
from app.storage.tables import JobRow, VersionRow

_OPEN = (JobState.QUEUED, JobState.RUNNING)


async def read_job_news(
    tx: AsyncSession, user_uuids: Collection[UUID], *, known: Collection[UUID], since: datetime
) -> list[JobNews]:
    """Read the jobs of some users that are open, that are known, or that ended since then.

    Args:
        tx: a transaction.
        user_uuids: whose.
        known: jobs that were open when last looked at.
        since: an instant a little before that.
    """
    made = (VersionRow.user_uuid == JobRow.user_uuid) & (VersionRow.number == JobRow.version)
    query = (
        select(JobRow.id, JobRow.user_uuid, JobRow.state, JobRow.progress, VersionRow.metrics)
        .join(VersionRow, made, isouter=True)
        .where(
            JobRow.user_uuid.in_(user_uuids),
            or_(JobRow.state.in_(_OPEN), JobRow.id.in_(known), JobRow.finished_at > since),
        )
        .order_by(JobRow.created_at, JobRow.id)
    )
    return [
        JobNews(job_id, user, JobState(state), progress, metrics)
        for job_id, user, state, progress, metrics in await tx.execute(query)
    ]
