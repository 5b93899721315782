"""The trainer that workers use: fits one person's decoder, examines it, and fits it on everything.

Each fold is fitted by the very recipe of the final fit, and measured as it would be served, gate
and correction included; the final weights are those of the fit on all clips, and reach as far as
the judge allows.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from math import isfinite
from typing import Any

import numpy as np
from torch import Tensor

from app.domain.body import measure_bones
from app.domain.versions import Verdict
from app.personalize.exam import Examined, examine, measure_rival
from app.personalize.folds import MIN_BLOCKS, Fold, cut_blocks, make_folds
from app.personalize.judge import BLEND, REACHES, Evidence, Rival, Ruling, join, judge
from app.personalize.run import Learned, Lesson, Report
from models.checkpoint import (
    Checkpoint,
    CheckpointError,
    dump_personal,
    load_checkpoint,
    load_personal,
)
from models.data.clips import Clip, data_hash
from models.decoder import Decoder
from models.metrics import FRAMES
from models.personal import PersonalDecoder
from models.predictor import Predictor
from models.rounding import round_matrices
from models.training.finetune import (
    FinetuneConfig,
    FinetuneProgress,
    blend,
    finetune,
    learn_nearby,
)
from models.uncertainty import fit_scale


@dataclass(frozen=True, eq=False)
class _Course:
    """What all fits of a run have in common."""

    base: Checkpoint
    config: FinetuneConfig
    report: Report
    fits: int
    corrects: bool = True

    def fit(self, clips: Sequence[Clip], *, number: int, phase: str) -> PersonalDecoder:
        """Fit a version as it will be served: decoder, gate and correction."""
        net = self.base.predictor
        fitted = finetune(net, clips, self.config, report=self._tell(phase, number))
        decoder = blend(net.decoder, fitted, BLEND)
        round_matrices(decoder)
        version = learn_rest(net, decoder, clips)
        return version if self.corrects else replace(version, correction=None)

    def examine(self, folds: Sequence[Fold], *, first: int = 0) -> list[Examined]:
        """Fit and measure a candidate for every fold."""
        return [
            examine(self.fit(fold.learn, number=first + i, phase="judging"), fold)
            for i, fold in enumerate(folds)
        ]

    def _tell(self, phase: str, number: int) -> Callable[[FinetuneProgress], None]:
        def tell(progress: FinetuneProgress) -> None:
            done, steps = progress.step + number * progress.steps, self.fits * progress.steps
            self.report(
                {
                    "phase": phase,
                    "step": done,
                    "steps": steps,
                    "loss": round(progress.loss, 5) if isfinite(progress.loss) else None,
                    "seconds_left": round((steps - done) * progress.seconds / progress.step, 1),
                }
            )

        return tell


def train(lesson: Lesson, report: Report, *, config: FinetuneConfig | None = None) -> Learned:
    """Fit on parts of the clips, judge on the others, and fit on all of them."""
    blocks = cut_blocks(lesson.clips)
    folds = make_folds(blocks)
    if not folds:
        return Learned(Verdict.TOO_LITTLE_DATA, _explain_too_little(blocks), None, {})
    base, active = load_checkpoint(lesson.base), _load_active(lesson)
    is_refit = active is not None and lesson.clips[-1].trial in lesson.active_trials
    runs = 2 if is_refit and lesson.active_base is not None else 1
    config = config or _configure(lesson.steps)
    course = _Course(base, config, report, fits=runs * len(folds) + 1)
    examined = course.examine(folds)
    rival = _meet(active, lesson, folds, examined)
    if active is not None and runs == 2:
        old = replace(course, base=_load_base(lesson), corrects=active.correction is not None)
        rival = _refight(active, old, folds, examined)
    evidence = _gather(folds, examined, rival=rival)
    ruling = judge(evidence)
    whole = course.fit(blocks, number=runs * len(folds), phase="fitting")
    if not _is_finite(whole):
        return Learned(Verdict.REJECT, "The fit went astray: its weights are not finite.", None, {})
    metrics = _summarise(ruling, evidence, lesson)
    described = {
        "data": data_hash(list(lesson.clips)),
        "blend": BLEND,
        "finetuning": _describe(course.config),
        "bones": np.round(_measure_bones(lesson.clips), 4).tolist(),
    }
    scale = fit_scale(base.radius, [part.distances(ruling.reach) for part in examined])
    if scale is not None:
        described["radius_scale"] = metrics["radius_scale"] = round(scale, 4)
    blob = dump_personal(
        whole.decoder,
        described,
        base_sha256=base.sha256,
        familiarity=whole.reaching(ruling.reach).familiarity,
        correction=whole.correction,
    )
    return Learned(ruling.verdict, ruling.message, blob, metrics)


def learn_rest(net: Predictor, decoder: Decoder, clips: Sequence[Clip]) -> PersonalDecoder:
    """Make a version of a fitted decoder: learn its gate and correction, which takes a moment."""
    gate, correction = learn_nearby(net, clips)
    return PersonalDecoder(net, decoder, gate, {}, correction)


def _is_finite(version: PersonalDecoder) -> bool:
    weights: list[Tensor] = list(version.decoder.parameters())
    if version.correction is not None:
        weights += version.correction.tensors().values()
    return all(bool(weight.isfinite().all()) for weight in weights)


def _configure(steps: int | None) -> FinetuneConfig:
    return FinetuneConfig() if steps is None else FinetuneConfig(steps=steps)


def _load_active(lesson: Lesson) -> PersonalDecoder | None:
    """Build the active version behind the encoder that it was fitted on.

    One that cannot be read, which no service can run either, is nothing to compare with.
    """
    if lesson.active is None:
        return None
    try:
        base = _load_base(lesson)
        return load_personal(lesson.active, base.predictor, base_sha256=base.sha256)
    except CheckpointError:
        return None


def _load_base(lesson: Lesson) -> Checkpoint:
    """Load the base that the active version runs on."""
    return load_checkpoint(lesson.active_base or lesson.base)


def _gather(
    folds: Sequence[Fold], examined: Sequence[Examined], *, rival: Rival | None
) -> Evidence:
    trials = {
        fold.trial: found.like for fold, found in zip(folds, examined, strict=True) if fold.trial
    }
    return Evidence(
        like=join([found.like for found in examined]),
        unlike=join([found.unlike for found in examined]),
        trials=trials,
        rival=rival,
    )


def _meet(
    active: PersonalDecoder | None,
    lesson: Lesson,
    folds: Sequence[Fold],
    examined: Sequence[Examined],
) -> Rival | None:
    """Measure the active version where neither it nor the candidate was trained: the new trial."""
    newest = lesson.clips[-1].trial
    if active is None or newest in lesson.active_trials:
        return None
    for fold, found in zip(folds, examined, strict=True):
        if fold.trial == newest:
            return measure_rival(active, fold.like, found.like)
    return None


def _refight(
    active: PersonalDecoder, course: _Course, folds: Sequence[Fold], examined: Sequence[Examined]
) -> Rival:
    """Measure the active version's recipe, on its own base, where the candidate's was measured.

    The version itself was fitted on every trial, so nothing is left to measure it on. What can be
    compared fairly are fits on the same parts of the trials, on the old base and on the new one.
    """
    half = REACHES[0] if active.familiarity is None else active.familiarity.rule.half
    reach = next((one for one in REACHES if one <= half), REACHES[-1])
    old = join([part.both for part in course.examine(folds, first=len(folds))])
    new = join([part.both for part in examined])
    return Rival(
        base=old.before[:, -1],
        active=old.after[REACHES.index(reach), :, -1],
        candidate=new.after[:, :, -1],
        where="motion left out",
    )


def _summarise(ruling: Ruling, evidence: Evidence, lesson: Lesson) -> dict[str, Any]:
    metrics: dict[str, Any] = {
        "frames": list(FRAMES),
        "blend": BLEND,
        "reach": ruling.reach,
        "clips": len(lesson.clips),
        "seen": evidence.like.summarise(ruling.reach),
        "unseen": evidence.unlike.summarise(ruling.reach),
        "reaches": {
            str(reach): {
                "seen": round(evidence.like.compare(reach).ratio, 4),
                "unseen": round(evidence.unlike.compare(reach).ratio, 4),
            }
            for reach in REACHES
        },
    }
    rival = evidence.rival
    if rival is not None:
        candidate = rival.candidate[REACHES.index(ruling.reach)]
        metrics["rival"] = {
            "where": rival.where,
            "base_cm2": round(float(rival.base.mean()), 3),
            "active_cm2": round(float(rival.active.mean()), 3),
            "candidate_cm2": round(float(candidate.mean()), 3),
        }
    return metrics


def _describe(config: FinetuneConfig) -> dict[str, Any]:
    return asdict(replace(config, rates=dict(config.rates)))


def _measure_bones(clips: Sequence[Clip]) -> np.ndarray:
    bones = np.stack([measure_bones(clip.poses) for clip in clips])
    return np.asarray(np.median(bones, axis=0))


def _explain_too_little(blocks: Sequence[Clip]) -> str:
    return (
        f"Too little to judge by: motion of a second or more, told apart: {len(blocks)}; "
        f"record {MIN_BLOCKS} or more."
    )
