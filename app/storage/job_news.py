"""What open streams are told of jobs, for all of them in one query."""

from collections.abc import Collection
from datetime import datetime
from uuid import UUID

from sqlalchemy import CompoundSelect, literal_column, select, union
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
    asked = _ask(user_uuids, known=known, since=since).subquery()
    made = (VersionRow.user_uuid == JobRow.user_uuid) & (VersionRow.number == JobRow.version)
    query = (
        select(JobRow.id, JobRow.user_uuid, JobRow.state, JobRow.progress, VersionRow.metrics)
        .join(VersionRow, made, isouter=True)
        .where(JobRow.id.in_(select(asked.c.id)))
        .order_by(JobRow.created_at, JobRow.id)
    )
    return [
        JobNews(job_id, user, JobState(state), progress, metrics)
        for job_id, user, state, progress, metrics in await tx.execute(query)
    ]


def _ask(
    user_uuids: Collection[UUID], *, known: Collection[UUID], since: datetime
) -> CompoundSelect[UUID]:
    """Ask for the ids, each kind by its own index: of all jobs that users had, few are news."""
    theirs = select(JobRow.id).where(JobRow.user_uuid.in_(user_uuids))
    parts = [theirs.where(JobRow.state == literal_column(f"'{state}'")) for state in _OPEN]
    return union(
        *parts, theirs.where(JobRow.finished_at > since), theirs.where(JobRow.id.in_(known))
    )
