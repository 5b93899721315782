"""The personal flow without a service: recordings in memory go through the very same run."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from app.domain.recordings import RawFrames, pack_frames
from app.domain.versions import Verdict
from app.personalize.run import Outcome, Report, Task, TaskClip, Trainer, run_task
from app.personalize.trainer import train
from models.baselines import Forecaster
from models.checkpoint import load_checkpoint, load_personal
from models.data.clips import Clip
from models.skeleton import KINECT_V1


def personalize(
    base: bytes,
    clips: Sequence[Clip],
    report: Report,
    *,
    threads: int = 1,
    steps: int | None = None,
    trainer: Trainer = train,
) -> Outcome:
    """Check, train and judge, as a worker does with uploaded trials.

    Args:
        base: the base model, as its file.
        clips: one person's, in the net's skeleton, y up.
        report: told how far it is.
        threads: for arithmetic.
        steps: of one fit; None for those of the recipe.
        trainer: fits and judges; that of the service unless told.
    """
    ordered = sorted(clips, key=lambda clip: clip.trial)
    task = Task(
        skeleton=KINECT_V1.name,
        up="y",
        clips=[_pack(clip, i) for i, clip in enumerate(ordered)],
        base=base,
        active=None,
        parent=0,
        threads=threads,
        steps=steps,
    )
    return run_task(task, trainer, report)


def choose_forecaster(base: bytes, outcome: Outcome) -> Forecaster:
    """Give what the service would answer with: the version if it was promoted, else the base."""
    checkpoint = load_checkpoint(base)
    if outcome.verdict is not Verdict.PROMOTE or outcome.blob is None:
        return checkpoint.predictor
    return load_personal(outcome.blob, checkpoint.predictor, base_sha256=checkpoint.sha256)


def describe(outcome: Outcome) -> Mapping[str, Any]:
    """Give the verdict and its figures, for a report."""
    return {"verdict": str(outcome.verdict), "message": outcome.message, **outcome.metrics}


def _pack(clip: Clip, ordinal: int) -> TaskClip:
    frames = RawFrames(t=np.arange(len(clip.poses)) / clip.rate_hz, joints=clip.poses)
    return TaskClip(clip.trial, ordinal, clip.action or None, [pack_frames(frames)])
