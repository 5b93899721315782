"""The end of a job: weights, version, activation and state of the job, all of it or nothing."""

from dataclasses import dataclass
from datetime import datetime
from typing import Any
from uuid import UUID

from sqlalchemy.ext.asyncio import AsyncSession

from app.domain.jobs import Claim, JobReason, JobState
from app.domain.versions import (
    BASE_NUMBER,
    ActivationKind,
    Standing,
    Verdict,
    VersionState,
    may_promote,
    must_withdraw,
)
from app.storage import leases, versions
from app.storage.leases import Hold
from app.storage.versions import NewVersion


class FencedJobError(Exception):
    """The job is somebody else's by now: nothing of this result may be stored."""


@dataclass(frozen=True, slots=True)
class Result:
    """What came out of a job.

    Attributes:
        verdict: the judge's.
        message: why, for an operator.
        blob: the weights, None where there was too little to train on.
        parent: the version that was active when the job began.
        base_sha256: the base that the weights run on.
        metrics: the judge's figures.
        trained_on: the trials of the clips that were good enough, oldest first.
    """

    verdict: Verdict
    message: str
    blob: bytes | None
    parent: int
    base_sha256: str
    metrics: dict[str, Any]
    trained_on: tuple[UUID, ...] = ()


async def finish(
    tx: AsyncSession, held: Claim, result: Result, *, now: datetime, keep: int
) -> JobReason:
    """End a job with its result; one that was called off ends so, and nothing is stored of it.

    Args:
        tx: a transaction for writing, of this alone.
        held: the claim of whoever worked on it.
        result: what came out.
        now: by `app.storage.clock`.
        keep: newest versions whose weights are kept.

    Returns:
        What became of it.

    Raises:
        FencedJobError: the claim is not the newest any more, or the user was erased; the
            transaction must end without being stored, which raising through it does.
        UnknownUserError: the user was erased just now.
    """
    standing = await versions.read_standing(tx, held.user_uuid)
    if await leases.look(tx, held, lock=True) is Hold.CANCELLED:
        await leases.close_cancelled(tx, held, now=now)
        return JobReason.CANCELLED
    number, reason = await _store(tx, held, result, standing, keep=keep)
    won = reason in {JobReason.PROMOTED, JobReason.AWAITS_PROMOTION}
    state = JobState.SUCCEEDED if won else JobState.REJECTED
    ours = await leases.close(
        tx, held, state=state, reason=reason, message=result.message, now=now, version=number
    )
    if not ours:
        raise FencedJobError(f"job {held.job_id} is no longer held by fence {held.fence}")
    return reason


async def _store(
    tx: AsyncSession, held: Claim, result: Result, standing: Standing, *, keep: int
) -> tuple[int | None, JobReason]:
    """Store what came out; gives the number of its version, if any, and what became of it."""
    number, reason = None, JobReason.TOO_LITTLE_DATA
    if result.blob is not None:
        number, reason = await _add_version(tx, held, result, result.blob, standing)
        await versions.purge(tx, held.user_uuid, keep=keep)
    elif result.verdict is not Verdict.TOO_LITTLE_DATA:
        reason = JobReason.DID_NOT_WIN
    if must_withdraw(result.verdict, standing, parent=result.parent):
        await versions.activate(
            tx, held.user_uuid, BASE_NUMBER, kind=ActivationKind.WITHDRAWN, actor=None
        )
    return number, reason


async def _add_version(
    tx: AsyncSession, held: Claim, result: Result, blob: bytes, standing: Standing
) -> tuple[int, JobReason]:
    """Store a version and activate it where it may be; gives its number and what became of it."""
    won = result.verdict is Verdict.PROMOTE
    new = NewVersion(
        blob=blob,
        parent=result.parent,
        base_sha256=result.base_sha256,
        trained_on=result.trained_on or held.trials,
        metrics=result.metrics,
        job_id=held.job_id,
        state=VersionState.CANDIDATE if won else VersionState.REJECTED,
    )
    version = await versions.add(tx, held.user_uuid, new)
    if not won:
        return version.number, _explain(result.verdict)
    if not may_promote(result.verdict, standing, parent=result.parent, sha256=version.sha256):
        return version.number, JobReason.AWAITS_PROMOTION
    await versions.activate(
        tx, held.user_uuid, version.number, kind=ActivationKind.PROMOTED, actor=None
    )
    return version.number, JobReason.PROMOTED


def _explain(verdict: Verdict) -> JobReason:
    too_little = verdict is Verdict.TOO_LITTLE_DATA
    return JobReason.TOO_LITTLE_DATA if too_little else JobReason.DID_NOT_WIN
