"""The end of a live recording: its clips are looked at, and a job is asked for."""

from collections.abc import Sequence
from datetime import datetime
from uuid import UUID

from sqlalchemy.ext.asyncio import AsyncSession

from app.domain.jobs import Job, JobReason
from app.domain.recordings import DamagedChunkError, unpack_frames
from app.domain.trials import ClipFlaw
from app.domain.users import User
from app.personalize.quality import QualityRules, check_clip
from app.storage import jobs, recordings
from app.storage.recordings import Recording
from app.storage.trials import StoredClip
from models.skeleton import SKELETONS


def examine(
    clip: StoredClip, *, skeleton: str, up: str, rules: QualityRules | None = None
) -> ClipFlaw | None:
    """Look at a stored clip by itself.

    Args:
        clip: with its frames.
        skeleton: name of the user's format.
        up: the user's up axis.
        rules: the thresholds.

    Returns:
        Why it is not to be trained on, None if it may be.
    """
    try:
        frames = unpack_frames(clip.chunks)
    except DamagedChunkError:
        return ClipFlaw.PERSON_LOST
    return check_clip(frames, SKELETONS[skeleton], up=up, rules=rules).flaw


async def store_recording(
    tx: AsyncSession,
    user: User,
    held: Recording,
    flaws: Sequence[tuple[int, ClipFlaw | None]],
    *,
    finetune: bool,
    requested_by: UUID | None,
    now: datetime,
) -> Job | None:
    """Complete a trial and ask for a job, both or neither; doing so again changes nothing.

    Args:
        tx: a transaction for writing.
        user: whose.
        held: the recording.
        flaws: what was found of each clip, by ordinal. Without clips there is no job.
        finetune: whether a job is wanted.
        requested_by: the key that asks.
        now: the moment.

    Raises:
        FencedError, TrialConflictError, UserDeletedError: the recording is not this stream's now.
    """
    wanted = finetune and bool(flaws)
    found = {ordinal: flaw for ordinal, flaw in flaws if flaw is not None}
    is_new = await recordings.stop(tx, held, finetune=wanted, flaws=found, now=now)
    if not wanted:
        return None
    if not is_new:  # the answer was lost, not the job
        ended = await recordings.find_ended(tx, user.uuid, held.trial_id)
        return None if ended is None else ended.job
    job_id = await jobs.enqueue(tx, user.uuid, reason=JobReason.TRIAL, requested_by=requested_by)
    return await jobs.get(tx, job_id)
