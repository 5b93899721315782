"""The queue of jobs, which is a table: made, shown, called off.

Working on jobs is in `app.storage.leases`.
"""

from collections.abc import Sequence
from datetime import datetime
from uuid import UUID

from sqlalchemy import exists, select, text, update
from sqlalchemy.ext.asyncio import AsyncSession

from app.domain.errors import JobQueuedError, UnknownJobError
from app.domain.events import Action
from app.domain.jobs import Job, JobReason, JobState
from app.domain.pagination import Cursor, Page
from app.storage import audit
from app.storage.announcements import Topic, announce
from app.storage.dialects import upsert
from app.storage.paging import page_query
from app.storage.tables import JobRow, UserRow
from app.storage.versions import lock_user

_QUEUED = text("state = 'queued'")


async def enqueue(
    tx: AsyncSession, user_uuid: UUID, *, reason: JobReason, requested_by: UUID | None
) -> UUID:
    """Ask for a job over all trials that will be stored when it starts; gives its id.

    Where one waits already, that one will do: ten trials in a burst are one job. This locks it
    until the end of the transaction, so that no worker starts it without what is stored here.
    """
    row = {
        "user_uuid": user_uuid,
        "state": JobState.QUEUED,
        "reason": reason,
        "explicit": False,
        "trials": None,
        "requested_by": requested_by,
    }
    job_id: UUID = await upsert(
        tx,
        JobRow,
        row,
        on=("user_uuid", "explicit"),
        where=_QUEUED,
        change={"state": JobState.QUEUED},
        returning="id",
    )
    announce(tx, Topic.JOBS)
    return job_id


async def enqueue_explicit(
    tx: AsyncSession, user_uuid: UUID, trials: Sequence[UUID], *, requested_by: UUID | None
) -> UUID:
    """Ask for a job over exactly these trials; gives its id.

    Raises:
        JobQueuedError: a job of this user waits already; such a list is never merged.
    """
    await lock_user(tx, user_uuid)
    waiting = exists().where(JobRow.user_uuid == user_uuid, JobRow.state == JobState.QUEUED)
    if await tx.scalar(select(waiting)):
        raise JobQueuedError("A job of this user waits already; cancel it, or wait for it.")
    row = JobRow(
        user_uuid=user_uuid,
        state=JobState.QUEUED,
        reason=JobReason.REQUEST,
        explicit=True,
        trials=[str(trial) for trial in trials],
        requested_by=requested_by,
    )
    tx.add(row)
    await tx.flush()
    announce(tx, Topic.JOBS)
    return row.id


async def get(tx: AsyncSession, job_id: UUID) -> Job:
    """Find a job.

    Raises:
        UnknownJobError: there is none.
    """
    found = (await tx.execute(_SELECT.where(JobRow.id == job_id))).one_or_none()
    if found is None:
        raise UnknownJobError(f"There is no job {job_id}.")
    return _to_job(found[0], found[1])


async def list_page(
    tx: AsyncSession,
    *,
    user: str | None = None,
    state: JobState | None = None,
    after: Cursor | None,
    limit: int,
) -> Page[Job]:
    """List jobs, newest first."""
    query = _SELECT
    if user is not None:
        query = query.where(UserRow.id == user)
    if state is not None:
        query = query.where(JobRow.state == state)
    paged = page_query(query, order=(JobRow.created_at, JobRow.id), after=after, limit=limit)
    rows = [(row, owner) for row, owner in await tx.execute(paged)]
    last = rows[limit - 1][0] if len(rows) > limit else None
    return Page(
        items=[_to_job(row, owner) for row, owner in rows[:limit]],
        next_cursor=None if last is None else Cursor(last.created_at, last.id).encode(),
    )


async def list_of_user(tx: AsyncSession, user_uuid: UUID) -> list[Job]:
    """List all jobs of a user, oldest first."""
    query = _SELECT.where(JobRow.user_uuid == user_uuid).order_by(JobRow.created_at, JobRow.id)
    return [_to_job(row, owner) for row, owner in await tx.execute(query)]


async def cancel(tx: AsyncSession, job_id: UUID, *, actor: UUID | None, now: datetime) -> Job:
    """Call a job off; for one that has ended, nothing changes.

    One that waits, or whose worker is gone, is cancelled at once; a worker that has it sees it
    within a second.

    Raises:
        UnknownJobError: there is none.
    """
    idle = (JobRow.state == JobState.QUEUED) | (
        (JobRow.state == JobState.RUNNING) & (JobRow.lease_until <= now)
    )
    ended = (
        update(JobRow)
        .where(JobRow.id == job_id, idle)
        .values(
            state=JobState.CANCELLED,
            reason=JobReason.CANCELLED,
            finished_at=now,
            fence=JobRow.fence + 1,
            lease_owner=None,
            lease_until=None,
        )
        .returning(JobRow.user_uuid)
        .execution_options(synchronize_session=False)
    )
    asked = (
        update(JobRow)
        .where(JobRow.id == job_id, JobRow.state == JobState.RUNNING, ~JobRow.cancelling)
        .values(cancelling=True)
        .returning(JobRow.user_uuid)
        .execution_options(synchronize_session=False)
    )
    changed = await tx.scalar(ended) or await tx.scalar(asked)
    if changed is not None:
        audit.record(tx, Action.JOB_CANCELLED, actor=actor, user_uuid=changed)
        await tx.flush()
        announce(tx, Topic.JOBS, Topic.PROGRESS)
    return await get(tx, job_id)


_SELECT = (
    select(JobRow, UserRow.id)
    .join(UserRow, UserRow.uuid == JobRow.user_uuid)
    .execution_options(populate_existing=True)
)


def _to_job(row: JobRow, user: str) -> Job:
    return Job(
        id=row.id,
        user=user,
        state=JobState(row.state),
        reason=JobReason(row.reason),
        trials=None if row.trials is None else tuple(UUID(trial) for trial in row.trials),
        explicit=row.explicit,
        requested_by=row.requested_by,
        attempt=row.attempt,
        progress=row.progress,
        message=row.message,
        cancelling=row.cancelling,
        created_at=row.created_at,
        started_at=row.started_at,
        finished_at=row.finished_at,
        version=row.version,
    )
