"""The beginning of the personal flow: a trial comes in, is looked at, and asks for a job.

Trial and job are one transaction: an accepted trial is never without whatever trains on it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from uuid import UUID

import numpy as np
from jaxtyping import Float
from sqlalchemy.ext.asyncio import AsyncSession

from app.domain.errors import NothingToTrainOnError
from app.domain.frames import check_confidence, check_joints, check_times
from app.domain.jobs import Job, JobReason
from app.domain.recordings import RawFrames, pack_frames
from app.domain.trials import ClipFlaw, ClipInfo, Trial
from app.domain.users import User
from app.personalize.quality import QualityRules, check_clip
from app.storage import jobs, trials
from app.storage.trials import NewClip
from models.skeleton import SKELETONS

RATE_HZ = 30.0
"""Of frames that come without times."""


@dataclass(frozen=True, slots=True)
class Sensor:
    """How a user's poses come.

    Attributes:
        skeleton: name of the format.
        up: which axis points up.
        coordinate_max_m: largest coordinate that is taken for one.
    """

    skeleton: str
    up: str
    coordinate_max_m: float = 100.0


@dataclass(frozen=True, slots=True)
class Recorded:
    """What was stored: the trial, and the job that will train on it, if one was asked for."""

    trial: Trial
    job: Job | None


def make_frames(
    joints: Float[np.ndarray, "time joint 3"],
    t: Float[np.ndarray, " times"] | None,
    confidence: Float[np.ndarray, "confidences number"] | None,
    sensor: Sensor,
) -> RawFrames:
    """Check the frames of one clip; without times they are 30 Hz and the newest is at 0.

    Raises:
        BadFrameError: and its kinds.
    """
    count = len(SKELETONS[sensor.skeleton].joints)
    check_joints(joints, count, coordinate_max_m=sensor.coordinate_max_m)
    if t is None:
        t = -np.arange(len(joints) - 1, -1, -1) / RATE_HZ
    check_times(t, len(joints))
    if confidence is not None:
        check_confidence(confidence, count)
    return RawFrames(
        t=t.astype(np.float64),
        joints=joints.astype(np.float32),
        confidence=None if confidence is None else confidence.astype(np.float32),
    )


def examine_clip(
    frames: RawFrames,
    sensor: Sensor,
    *,
    ordinal: int,
    action: str | None,
    rules: QualityRules | None = None,
) -> NewClip:
    """Look at a clip by itself and pack it as it was received, whatever is found."""
    checked = check_clip(frames, SKELETONS[sensor.skeleton], up=sensor.up, rules=rules)
    return pack_clip(frames, ordinal=ordinal, action=action, flaw=checked.flaw)


def pack_clip(
    frames: RawFrames, *, ordinal: int, action: str | None, flaw: ClipFlaw | None
) -> NewClip:
    """Pack a clip with what is known of it."""
    info = ClipInfo(
        ordinal=ordinal, action=action, frames=len(frames), seconds=frames.seconds, flaw=flaw
    )
    return NewClip(info, pack_frames(frames))


async def store_upload(
    tx: AsyncSession,
    user: User,
    *,
    label: str | None,
    finetune: bool,
    clips: Sequence[NewClip],
    requested_by: UUID | None,
) -> Recorded:
    """Store a trial and ask for a job, both or neither."""
    trial = await trials.add(tx, user, label=label, finetune=finetune, clips=clips)
    if not finetune:
        return Recorded(trial, None)
    job_id = await jobs.enqueue(tx, user.uuid, reason=JobReason.TRIAL, requested_by=requested_by)
    return Recorded(trial, await jobs.get(tx, job_id))


async def request_finetuning(
    tx: AsyncSession, user: User, chosen: Sequence[UUID] | None, *, requested_by: UUID | None
) -> Job:
    """Ask for a job without a new trial.

    Args:
        tx: a transaction for writing.
        user: whose.
        chosen: exactly these trials; None for all that will be stored when it starts.
        requested_by: the key that asks.

    Raises:
        UnknownTrialError: this user has no such trial.
        NothingToTrainOnError: there is no stored trial, or the list is empty.
        JobQueuedError: an explicit list, while another job waits.
    """
    stored = await trials.list_stored(tx, user.uuid)
    if not stored or (chosen is not None and not chosen):
        raise NothingToTrainOnError("There is no stored trial to train on.")
    if chosen is None:
        job_id = await jobs.enqueue(
            tx, user.uuid, reason=JobReason.REQUEST, requested_by=requested_by
        )
        return await jobs.get(tx, job_id)
    for trial_id in chosen:
        trial = await trials.get(tx, user, trial_id)
        if trial.id not in stored:
            raise NothingToTrainOnError(f"Trial {trial_id} is {trial.state}, not stored.")
    ordered = [trial for trial in stored if trial in set(chosen)]
    job_id = await jobs.enqueue_explicit(tx, user.uuid, ordered, requested_by=requested_by)
    return await jobs.get(tx, job_id)
