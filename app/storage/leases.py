"""Working on jobs: claim one, keep it, give it back, end it.

A claim is a lease with a fence. Whatever a worker writes is guarded by the fence of its claim, so
that one that was taken for dead and comes back changes nothing.
"""

from datetime import datetime, timedelta
from enum import StrEnum
from typing import Any
from uuid import UUID

from sqlalchemy import case, exists, func, or_, select, update
from sqlalchemy.exc import IntegrityError
from sqlalchemy.ext.asyncio import AsyncSession
from sqlalchemy.orm import aliased

from app.domain.jobs import MAX_ATTEMPTS, Claim, JobReason, JobState, retry_after
from app.storage import trials
from app.storage.announcements import Topic, announce
from app.storage.tables import JobRow, TrialRow, UserRow


class Hold(StrEnum):
    """What a worker learns when it renews its lease."""

    HELD = "held"
    CANCELLED = "cancelled"
    LOST = "lost"


async def claim(
    tx: AsyncSession,
    *,
    owner: str,
    lease: timedelta,
    now: datetime,
    base_sha256: str | None = None,
) -> Claim | None:
    """Take the next job: one whose worker is gone, else by `app.domain.jobs.fair_order`.

    A job is taken over in place. Back in the queue it could meet the next one of its user.

    Args:
        tx: a transaction for writing.
        owner: who asks, for people.
        lease: how long the job is theirs without a sign of life.
        now: by `app.storage.clock`.
        base_sha256: the base that they fit on; jobs that are for another one are not theirs.

    Returns:
        None where there is nothing to do, or another worker was faster.
    """
    await _end_hopeless(tx, now)
    found = (await tx.execute(_next_query(now, base_sha256))).first()
    if found is None:
        return None
    row, user = found
    if row.state == JobState.QUEUED:
        user.served_at = now
    row.state = JobState.RUNNING
    row.fence += 1
    row.attempt += 1
    row.lease_owner, row.lease_until = owner, now + lease
    row.started_at = row.started_at or now
    row.progress = None
    try:
        async with tx.begin_nested():
            await tx.flush()
    except IntegrityError:  # another worker has this user since a moment ago
        tx.expunge_all()
        return None
    chosen = await _choose_trials(tx, row)
    row.trials = [str(trial) for trial in chosen]
    await tx.flush()
    announce(tx, Topic.PROGRESS)
    return Claim(
        job_id=row.id,
        user_uuid=row.user_uuid,
        fence=row.fence,
        attempt=row.attempt,
        trials=tuple(chosen),
        cancelled=row.cancelling,
    )


async def renew(
    tx: AsyncSession,
    held: Claim,
    *,
    lease: timedelta,
    now: datetime,
    progress: dict[str, Any] | None = None,
) -> Hold:
    """Show a sign of life, and learn whether the job is still wanted.

    Args:
        tx: a transaction for writing.
        held: the claim.
        lease: from now on.
        now: by `app.storage.clock`.
        progress: what to tell those who watch; None leaves it.
    """
    values: dict[str, Any] = {"lease_until": now + lease}
    if progress is not None:
        values["progress"] = progress
        announce(tx, Topic.PROGRESS)
    cancelling = await tx.scalar(
        update(JobRow)
        .where(*_guard(held))
        .values(**values)
        .returning(JobRow.cancelling)
        .execution_options(synchronize_session=False)
    )
    if cancelling is None:
        return Hold.LOST
    return Hold.CANCELLED if cancelling else Hold.HELD


async def look(tx: AsyncSession, held: Claim, *, lock: bool = False) -> Hold:
    """Learn whether the job is still wanted, without a sign of life; cheap enough to ask often.

    Args:
        tx: a transaction.
        held: the claim.
        lock: let nobody call it off before the transaction ends, which is one for writing then.
    """
    query = select(JobRow.cancelling).where(*_guard(held))
    cancelling = await tx.scalar(query.with_for_update() if lock else query)
    if cancelling is None:
        return Hold.LOST
    return Hold.CANCELLED if cancelling else Hold.HELD


async def give_back(tx: AsyncSession, held: Claim, *, now: datetime) -> bool:
    """Let another worker go on at once, because this one has to leave; not a failed attempt."""
    return await _change(
        tx, held, lease_owner=None, lease_until=now, attempt=JobRow.attempt - 1, progress=None
    )


async def fail(tx: AsyncSession, held: Claim, *, message: str, now: datetime) -> bool:
    """End an attempt that failed: to be tried again later, or for good after the last one.

    Nobody waits for another attempt at what was called off meanwhile: that ends as cancelled.
    """
    if await look(tx, held, lock=True) is Hold.CANCELLED:
        return await close_cancelled(tx, held, now=now)
    wait = retry_after(held.attempt)
    if wait is None:
        return await close(
            tx, held, state=JobState.FAILED, reason=JobReason.ERROR, message=message, now=now
        )
    return await _change(
        tx, held, lease_owner=None, lease_until=now + wait, message=message, progress=None
    )


async def close(
    tx: AsyncSession,
    held: Claim,
    *,
    state: JobState,
    reason: JobReason,
    message: str | None,
    now: datetime,
    version: int | None = None,
) -> bool:
    """End a job; tells whether it was still this worker's.

    Where it was not, the caller must let its transaction write nothing else.
    """
    if not JobState.RUNNING.may_become(state):
        raise ValueError(f"a running job cannot become {state}")
    return await _change(
        tx,
        held,
        state=state,
        reason=reason,
        message=message,
        finished_at=now,
        lease_owner=None,
        lease_until=None,
        version=version,
    )


async def close_cancelled(tx: AsyncSession, held: Claim, *, now: datetime) -> bool:
    """End a job that was called off; tells whether it was still this worker's."""
    state, reason = JobState.CANCELLED, JobReason.CANCELLED
    return await close(tx, held, state=state, reason=reason, message=None, now=now)


def _guard(held: Claim) -> tuple[Any, ...]:
    return (
        JobRow.id == held.job_id,
        JobRow.fence == held.fence,
        JobRow.state == JobState.RUNNING,
    )


async def _change(tx: AsyncSession, held: Claim, **values: Any) -> bool:  # noqa: ANN401 - columns
    changed = await tx.scalar(
        update(JobRow)
        .where(*_guard(held))
        .values(**values)
        .returning(JobRow.id)
        .execution_options(synchronize_session=False)
    )
    if changed is not None:
        announce(tx, Topic.JOBS, Topic.PROGRESS)  # its user's next job may be claimed now
    return changed is not None


async def _end_hopeless(tx: AsyncSession, now: datetime) -> None:
    """End jobs without a worker that are called off, or that have ended too many workers."""
    gone = (JobRow.state == JobState.RUNNING, JobRow.lease_until <= now)
    ended = {
        "finished_at": now,
        "fence": JobRow.fence + 1,
        "lease_owner": None,
        "lease_until": None,
    }
    await tx.execute(
        update(JobRow)
        .where(*gone, JobRow.cancelling)
        .values(state=JobState.CANCELLED, reason=JobReason.CANCELLED, **ended)
        .execution_options(synchronize_session=False)
    )
    told = func.coalesce(JobRow.message, f"Its worker vanished {MAX_ATTEMPTS} times.")
    await tx.execute(
        update(JobRow)
        .where(*gone, JobRow.attempt >= MAX_ATTEMPTS)
        .values(state=JobState.FAILED, reason=JobReason.ERROR, message=told, **ended)
        .execution_options(synchronize_session=False)
    )


def _next_query(now: datetime, base_sha256: str | None) -> Any:  # noqa: ANN401 - rows of two
    """Ask for the next job with its user, past those that another worker is about to take."""
    other = aliased(JobRow)
    busy = exists().where(other.user_uuid == JobRow.user_uuid, other.state == JobState.RUNNING)
    orphaned = (JobRow.state == JobState.RUNNING) & (JobRow.lease_until <= now)
    wanted = or_(JobRow.base_sha256.is_(None), JobRow.base_sha256 == base_sha256)
    return (
        select(JobRow, UserRow)
        .join(UserRow, UserRow.uuid == JobRow.user_uuid)
        .where(or_(orphaned, (JobRow.state == JobState.QUEUED) & ~busy), wanted)
        .order_by(
            case((JobRow.state == JobState.RUNNING, 0), else_=1),
            case((JobRow.reason == JobReason.NEW_BASE, 1), else_=0),
            UserRow.served_at.asc().nulls_first(),
            JobRow.created_at,
            JobRow.id,
        )
        .limit(1)
        .with_for_update(skip_locked=True, key_share=True)
    )


async def _choose_trials(tx: AsyncSession, row: JobRow) -> list[UUID]:
    """Give what a job trains on: what is still there of its list, or all that is stored."""
    if not row.explicit:
        return await trials.list_stored(tx, row.user_uuid)
    wanted = [UUID(trial) for trial in row.trials or ()]
    there = set(
        await tx.scalars(
            select(TrialRow.id).where(TrialRow.id.in_(wanted), TrialRow.user_uuid == row.user_uuid)
        )
    )
    return [trial for trial in wanted if trial in there]
