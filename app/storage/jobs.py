"""The queue of jobs, which is a table: made, shown, called off.

Working on jobs is in `app.storage.leases`.
"""

from collections.abc import Sequence
from datetime import datetime, timedelta
from typing import Any
from uuid import UUID

from sqlalchemy import case, exists, select, text, update
from sqlalchemy.ext.asyncio import AsyncSession

from app.domain.errors import JobQueuedError, UnknownJobError
from app.domain.events import Action
from app.domain.jobs import Job, JobReason, JobState
from app.domain.pagination import Cursor, Page
from app.domain.trials import TrialState
from app.domain.users import may_be_user_id
from app.domain.versions import VersionState
from app.storage import audit
from app.storage.announcements import Topic, announce
from app.storage.dialects import upsert
from app.storage.paging import page_query
from app.storage.tables import JobRow, TrialRow, UserRow, VersionRow
from app.storage.versions import lock_user

_QUEUED = text("state = 'queued'")
_SAME_MOMENT = timedelta(seconds=1)
"""Trial and job of one transaction may bear the time of two clocks."""


async def enqueue(
    tx: AsyncSession,
    user_uuid: UUID,
    *,
    reason: JobReason,
    requested_by: UUID | None,
    base_sha256: str | None = None,
) -> UUID:
    """Ask for a job over all trials that will be stored when it starts; gives its id.

    Where one waits already, that one will do: ten trials in a burst are one job. This locks it
    until the end of the transaction, so that no worker starts it without what is stored here.

    Args:
        tx: a transaction for writing.
        user_uuid: whose.
        reason: why; one that waits only because of a new base takes this one over.
        requested_by: the key that asks, None for the service itself.
        base_sha256: the base that it must be fitted on, None for that of whichever worker.
    """
    row = {
        "user_uuid": user_uuid,
        "state": JobState.QUEUED,
        "reason": reason,
        "explicit": False,
        "trials": None,
        "base_sha256": base_sha256,
        "requested_by": requested_by,
    }
    is_refit = JobRow.reason == JobReason.NEW_BASE
    change: dict[str, Any] = {"reason": case((is_refit, reason.value), else_=JobRow.reason)}
    if base_sha256 is not None:
        change["base_sha256"] = base_sha256
    job_id: UUID = await upsert(
        tx,
        JobRow,
        row,
        on=("user_uuid", "explicit"),
        where=_QUEUED,
        change=change,
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


async def enqueue_refits(tx: AsyncSession, base_sha256: str, *, limit: int) -> int:
    """Ask for a job for those whose active version runs on another base; once for each base.

    It waits for users whom somebody else decides about just now: nobody asks for them again.

    Args:
        tx: a transaction for writing.
        base_sha256: the base that everybody is to be fitted on from now on.
        limit: most users at a time.

    Returns:
        For how many users this was done; fewer than `limit`: for everybody.
    """
    done = UserRow.refitted_for.is_not_distinct_from(base_sha256)
    other = exists().where(
        VersionRow.user_uuid == UserRow.uuid,
        VersionRow.state == VersionState.ACTIVE,
        VersionRow.base_sha256 != base_sha256,
    )
    recorded = exists().where(
        TrialRow.user_uuid == UserRow.uuid, TrialRow.state == TrialState.STORED
    )
    chosen = (
        select(UserRow)
        .where(~done, other, recorded)
        .order_by(UserRow.created_at, UserRow.uuid)  # as whoever else locks many of them
        .limit(limit)
        .with_for_update(key_share=True)
    )
    users = list(await tx.scalars(chosen))
    for user in users:
        user.refitted_for = base_sha256
        await enqueue(
            tx,
            user.uuid,
            reason=JobReason.NEW_BASE,
            requested_by=None,
            base_sha256=base_sha256,
        )
    return len(users)


async def want_base(tx: AsyncSession, base_sha256: str) -> None:
    """Have jobs that wait for another base fitted on this one: that base may never come back."""
    await tx.execute(
        update(JobRow)
        .where(JobRow.state.in_((JobState.QUEUED, JobState.RUNNING)))
        .where(JobRow.base_sha256 != base_sha256)
        .values(base_sha256=base_sha256)
        .execution_options(synchronize_session=False)
    )


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
    """List jobs, newest first; of what can be nobody's id there are none."""
    query = _SELECT
    if user is not None:
        if not may_be_user_id(user):
            return Page(items=[], next_cursor=None)
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


async def find_asked_at(tx: AsyncSession, user_uuid: UUID, moment: datetime) -> Job | None:
    """Give the job that somebody who asked at a moment got: the newest one that was there then."""
    query = (
        _SELECT.where(JobRow.user_uuid == user_uuid, JobRow.created_at <= moment + _SAME_MOMENT)
        .order_by(JobRow.created_at.desc(), JobRow.id.desc())
        .limit(1)
    )
    found = (await tx.execute(query)).first()
    return None if found is None else _to_job(*found)


async def cancel(tx: AsyncSession, job_id: UUID, *, actor: UUID | None, now: datetime) -> Job:
    """Call a job off; for one that has ended, nothing changes.

    One that waits, for its first attempt or for another, or whose worker is gone, is cancelled at
    once; a worker that has it sees it within a second.

    Raises:
        UnknownJobError: there is none.
    """
    gone = JobRow.lease_owner.is_(None) | (JobRow.lease_until <= now)  # it failed, or vanished
    idle = (JobRow.state == JobState.QUEUED) | ((JobRow.state == JobState.RUNNING) & gone)
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
