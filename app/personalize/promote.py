"""Both ends of a run at the database: what it starts from, and what becomes of its outcome."""

from contextlib import suppress
from datetime import datetime
from uuid import UUID

from sqlalchemy.ext.asyncio import AsyncSession

from app.domain.errors import WeightsDamagedError, WeightsPurgedError
from app.domain.jobs import Claim, JobReason
from app.domain.trials import ClipFlaw
from app.personalize.run import Outcome, Task, TaskClip
from app.storage import results, trials, users, versions, weights
from app.storage.results import Result

LIVED_MIN_S = 10.0
"""A body that was seen live for less than this has no voice in whose the trials are."""


async def prepare_task(
    tx: AsyncSession,
    held: Claim,
    *,
    base: bytes,
    base_sha256: str,
    threads: int,
    steps: int | None = None,
) -> Task:
    """Read what a run starts from.

    The active version may run on an older base; then it comes with that one, to be compared with.

    Raises:
        UnknownUserError: they were erased.
    """
    user = await users.get_by_uuid(tx, held.user_uuid)
    active = await versions.read_active_of(tx, held.user_uuid)
    clips = [
        TaskClip(str(clip.trial_id), clip.info.ordinal, clip.info.action, list(clip.chunks))
        async for clip in trials.iterate_clips(tx, held.trials)
    ]
    blob, old_base = await _read_weights(tx, active.sha256), None
    if blob is not None and active.base_sha256 != base_sha256:
        old_base = await _read_weights(tx, active.base_sha256)
        blob = None if old_base is None else blob
    lived = await users.read_lived(tx, held.user_uuid)
    return Task(
        skeleton=user.skeleton,
        up=user.up,
        clips=clips,
        base=base,
        active=blob,
        parent=active.number,
        threads=threads,
        steps=steps,
        active_base=old_base,
        active_trials=await versions.list_trials(tx, held.user_uuid, active.number),
        lived=None if lived is None or lived.seconds < LIVED_MIN_S else list(lived.bones),
    )


async def _read_weights(tx: AsyncSession, sha256: str | None) -> bytes | None:
    """Read weights; what is gone or damaged is nothing to compare with."""
    if sha256 is None:
        return None
    with suppress(WeightsPurgedError, WeightsDamagedError):
        return await weights.get(tx, sha256)
    return None


async def store_outcome(
    tx: AsyncSession,
    held: Claim,
    outcome: Outcome,
    *,
    parent: int,
    base_sha256: str,
    now: datetime,
    keep: int,
) -> JobReason:
    """Store everything that a run ended with, in one transaction; raises as `results.finish`."""
    result = Result(
        verdict=outcome.verdict,
        message=outcome.message,
        blob=outcome.blob,
        parent=parent,
        base_sha256=base_sha256,
        metrics=outcome.metrics,
        trained_on=tuple(UUID(trial) for trial in outcome.trained_on),
    )
    reason = await results.finish(tx, held, result, now=now, keep=keep)
    if reason is JobReason.CANCELLED:
        return reason
    # whose body a trial shows is a matter of majority, and that may have turned
    await trials.clear_flaw(tx, held.trials, flaw=ClipFlaw.NOT_THIS_PERSON)
    for found in outcome.flaws:
        await trials.mark_flaw(tx, UUID(found.trial), found.ordinal, flaw=found.flaw)
    return reason
