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
from app.personalize.bodies import Bodies, Bones, tell_apart
from app.personalize.quality import Checked, check_clip
from models.arithmetic import arithmetic
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
        active_trials: the trials that it was trained on.
        lived: bones of whoever is seen on the user's streams, where that is known.
        steps: of one fit; None for those of the recipe.
    """

    skeleton: str
    up: str
    clips: list[TaskClip]
    base: bytes
    active: bytes | None
    parent: int
    threads: int
    active_base: bytes | None = None
    active_trials: list[str] = msgspec.field(default_factory=list)
    lived: list[float] | None = None
    steps: int | None = None


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
        trained_on: the trials of the clips that were.
    """

    verdict: Verdict
    message: str
    blob: bytes | None
    metrics: dict[str, Any]
    flaws: list[FoundFlaw]
    trained_on: list[str] = msgspec.field(default_factory=list)


@dataclass(frozen=True, eq=False)
class Lesson:
    """What a trainer gets.

    Attributes:
        base: the base model, as its file.
        active: weights of the active version, None for the base.
        clips: good clips in the net's skeleton, `trial` naming their trial, oldest trial first.
        active_base: the base that the active version runs on, as its file; None for `base`.
        active_trials: the trials that it was trained on.
        steps: of one fit; None for those of the recipe.
    """

    base: bytes
    active: bytes | None
    clips: tuple[Clip, ...]
    active_base: bytes | None = None
    active_trials: frozenset[str] = frozenset()
    steps: int | None = None


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
    bodies = _tell_bodies_apart(task, checked)
    pairs = zip(task.clips, checked, strict=True)
    checked = [_mark_stranger(clip, found, bodies) for clip, found in pairs]
    flaws = [
        FoundFlaw(clip.trial, clip.ordinal, found.flaw)
        for clip, found in zip(task.clips, checked, strict=True)
        if found.flaw is not None
    ]
    if bodies.is_open:
        return Outcome(Verdict.RETURN_TO_BASE, _explain_open(bodies), None, {}, flaws)
    clips = tuple(_to_clips(task.clips, checked))
    if not clips:
        return Outcome(Verdict.TOO_LITTLE_DATA, _explain_nothing(flaws), None, {}, flaws)
    if _is_nothing_new(task, clips):
        return Outcome(Verdict.REJECT, _explain_nothing_new(flaws, task), None, {}, flaws)
    report({"phase": "training", "clips": len(clips)})
    with arithmetic(task.threads):
        learned = trainer(_to_lesson(task, clips), report)
    return Outcome(
        verdict=learned.verdict,
        message=learned.message,
        blob=learned.blob,
        metrics=learned.metrics,
        flaws=flaws,
        trained_on=list(dict.fromkeys(clip.trial for clip in clips)),
    )


def _to_lesson(task: Task, clips: tuple[Clip, ...]) -> Lesson:
    return Lesson(
        base=task.base,
        active=task.active,
        clips=clips,
        active_base=task.active_base,
        active_trials=frozenset(task.active_trials),
        steps=task.steps,
    )


def _check(clip: TaskClip, task: Task) -> Checked:
    try:
        frames = unpack_frames(clip.chunks)
    except DamagedChunkError:
        return Checked(ClipFlaw.PERSON_LOST)
    return check_clip(frames, SKELETONS[task.skeleton], up=task.up)


def _tell_bodies_apart(task: Task, checked: list[Checked]) -> Bodies:
    trials: dict[str, list[Bones]] = {}
    for clip, found in zip(task.clips, checked, strict=True):
        bones = trials.setdefault(clip.trial, [])
        if found.bones is not None:
            bones.append(found.bones)
    return tell_apart(trials, None if task.lived is None else np.array(task.lived))


def _mark_stranger(clip: TaskClip, found: Checked, bodies: Bodies) -> Checked:
    if clip.trial in bodies.strangers and found.flaw is None and not bodies.is_open:
        return Checked(ClipFlaw.NOT_THIS_PERSON)
    return found


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


def _is_nothing_new(task: Task, clips: tuple[Clip, ...]) -> bool:
    """Tell whether new trials came, and none of them can be trained on.

    The same fit once more would only give the same weights.
    """
    known, usable = set(task.active_trials), {clip.trial for clip in clips}
    came = {clip.trial for clip in task.clips}
    return task.active_base is None and usable == known and came != known


def _explain_nothing_new(flaws: list[FoundFlaw], task: Task) -> str:
    newest = task.clips[-1].trial  # what is wrong with older ones was told when they came
    new = [flaw for flaw in flaws if flaw.trial == newest]
    kinds = dict.fromkeys(flaw.flaw for flaw in new)
    reasons = " ".join(kind.meaning for kind in kinds)
    return f"Nothing of the new trial can be trained on; the active version stays. {reasons}"


def _explain_open(bodies: Bodies) -> str:
    return (
        f"{len(bodies.strangers)} trials show different people, and as many speak for one as for "
        "another. The base answers until one more trial decides, or the wrong one is erased and "
        "fine-tuning is asked for."
    )


def _explain_nothing(flaws: list[FoundFlaw]) -> str:
    if not flaws:
        return "There is no clip to train on."
    kinds = dict.fromkeys(flaw.flaw for flaw in flaws)
    return "No clip can be trained on. " + " ".join(kind.meaning for kind in kinds)
