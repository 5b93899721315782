"""The story of one fine-tuning run, from stored clips to a judged result. Runs in a child process.

Nothing here knows of databases or leases: a task comes in, a result goes out, and on the way
somebody is told how far it is.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from app.domain.recordings import DamagedChunkError, unpack_frames
from app.domain.trials import ClipFlaw
from app.domain.versions import Verdict
from app.personalize.quality import Checked, check_clip, is_stranger
from models.data.clips import Clip
from models.skeleton import SKELETONS

SOURCE = "kinecast"
Report = Callable[[Mapping[str, Any]], None]


class TaskClip(msgspec.Struct):
    """A stored clip: `trial` names its trial, `chunks` are its packed frames."""

    trial: str
    ordinal: int
    action: str | None
    chunks: list[bytes]


class Task(msgspec.Struct):
    """What a run starts from.

    Attributes:
        skeleton, up: how the user's poses come.
        clips: of all trials, oldest trial first.
        base: the base model, as its file.
        active: weights of the active version, None for the base.
        parent: its number, 0 for the base.
        threads: for arithmetic.
        active_base: the base that the active version runs on, as its file; None for `base`.
    """

    skeleton: str
    up: str
    clips: list[TaskClip]
    base: bytes
    active: bytes | None
    parent: int
    threads: int
    active_base: bytes | None = None


class FoundFlaw(msgspec.Struct):
    """A clip that was not trained on, and why."""

    trial: str
    ordinal: int
    flaw: ClipFlaw


class Outcome(msgspec.Struct):
    """What a run ends with.

    Attributes:
        verdict: the judge's.
        message: why, for an operator.
        blob: the weights, None where there was too little.
        metrics: the judge's figures.
        flaws: clips that were not trained on.
    """

    verdict: Verdict
    message: str
    blob: bytes | None
    metrics: dict[str, Any]
    flaws: list[FoundFlaw]


@dataclass(frozen=True, eq=False)
class Lesson:
    """What a trainer gets.

    Attributes:
        base: the base model, as its file.
        active: weights of the active version, None for the base.
        clips: good clips in the net's skeleton, `trial` naming their trial, oldest trial first.
        active_base: the base that the active version runs on, as its file; None for `base`.
    """

    base: bytes
    active: bytes | None
    clips: tuple[Clip, ...]
    active_base: bytes | None = None


@dataclass(frozen=True, eq=False)
class Learned:
    """What a trainer gives: weights, the judge's verdict on them, and its reasons."""

    verdict: Verdict
    message: str
    blob: bytes | None
    metrics: dict[str, Any]


Trainer = Callable[[Lesson, Report], Learned]
"""The port to the nets: fits and judges. `report` may raise to stop it."""


def run_task(task: Task, trainer: Trainer, report: Report) -> Outcome:
    """Look at every clip, leave out what must not be learned, train, and judge.

    Args:
        task: what to start from.
        trainer: fits and judges.
        report: told how far it is.
    """
    report({"phase": "checking", "clips": len(task.clips)})
    checked = [_check(clip, task) for clip in task.clips]
    checked = _leave_out_strangers(task.clips, checked)
    flaws = [
        FoundFlaw(clip.trial, clip.ordinal, found.flaw)
        for clip, found in zip(task.clips, checked, strict=True)
        if found.flaw is not None
    ]
    clips = tuple(_to_clips(task.clips, checked))
    lesson = Lesson(task.base, task.active, clips, task.active_base)
    if not lesson.clips:
        return Outcome(Verdict.TOO_LITTLE_DATA, _explain_nothing(flaws), None, {}, flaws)
    report({"phase": "training", "clips": len(lesson.clips)})
    learned = trainer(lesson, report)
    return Outcome(learned.verdict, learned.message, learned.blob, learned.metrics, flaws)


def _check(clip: TaskClip, task: Task) -> Checked:
    try:
        frames = unpack_frames(clip.chunks)
    except DamagedChunkError:
        return Checked(ClipFlaw.PERSON_LOST)
    return check_clip(frames, SKELETONS[task.skeleton], up=task.up)


def _leave_out_strangers(clips: list[TaskClip], checked: list[Checked]) -> list[Checked]:
    """Mark the trials whose bones are not those of the trials before them."""
    known: list[Any] = []
    judged = list(checked)
    for trial in dict.fromkeys(clip.trial for clip in clips):
        places = [i for i, clip in enumerate(clips) if clip.trial == trial]
        bones = [bone for i in places if (bone := checked[i].bones) is not None]
        if not is_stranger(bones, known):
            known += bones
            continue
        for i in places:
            judged[i] = Checked(checked[i].flaw or ClipFlaw.NOT_THIS_PERSON)
    return judged


def _to_clips(clips: list[TaskClip], checked: list[Checked]) -> list[Clip]:
    return [
        Clip(
            poses=np.ascontiguousarray(piece, dtype=np.float32),
            subject="",
            action=clip.action or "",
            trial=clip.trial,
            source=SOURCE,
        )
        for clip, found in zip(clips, checked, strict=True)
        for piece in found.pieces
    ]


def _explain_nothing(flaws: list[FoundFlaw]) -> str:
    if not flaws:
        return "There is no clip to train on."
    kinds = dict.fromkeys(flaw.flaw for flaw in flaws)
    return "No clip can be trained on. " + " ".join(kind.meaning for kind in kinds)
