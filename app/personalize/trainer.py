"""The trainer that workers use: fits one person's decoder, examines it, and fits it on everything.

Each fold is fitted by the very recipe of the final fit, and measured as it would be served, gate
included; the final weights are those of the fit on all clips, blended as far as the judge allows.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import torch

from app.domain.body import measure_bones
from app.domain.versions import Verdict
from app.personalize.exam import Examined, examine, measure_rival
from app.personalize.folds import MIN_BLOCKS, Fold, cut_blocks, make_folds
from app.personalize.judge import SHARES, Evidence, Rival, Ruling, join, judge
from app.personalize.run import Learned, Lesson, Report
from models.checkpoint import Checkpoint, dump_personal, load_checkpoint, load_personal
from models.data.clips import Clip, data_hash
from models.data.windows import cut_windows
from models.familiarity import Familiarity
from models.metrics import FRAMES
from models.personal import PersonalDecoder
from models.predictor import Predictor
from models.training.finetune import FinetuneConfig, FinetuneProgress, blend, finetune
from models.uncertainty import fit_scale

_ENCODE_BATCH = 512


@dataclass(frozen=True, eq=False)
class _Course:
    """What all fits of a run have in common."""

    base: Checkpoint
    config: FinetuneConfig
    report: Report
    fits: int

    def fit(self, clips: Sequence[Clip], *, number: int, phase: str) -> PersonalDecoder:
        """Fit a decoder and its gate."""
        tell = self._tell(phase, number)
        decoder = finetune(self.base.predictor, clips, self.config, report=tell)
        gate = learn_familiarity(self.base.predictor, clips)
        return PersonalDecoder(self.base.predictor, decoder, gate, {})

    def _tell(self, phase: str, number: int) -> Callable[[FinetuneProgress], None]:
        def tell(progress: FinetuneProgress) -> None:
            left = progress.seconds_left
            left += (
                (self.fits - number - 1)
                * left
                * progress.steps
                / max(progress.steps - progress.step, 1)
            )
            self.report(
                {
                    "phase": phase,
                    "step": progress.step + number * progress.steps,
                    "steps": self.fits * progress.steps,
                    "loss": round(progress.loss, 5),
                    "seconds_left": round(left, 1),
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
    course = _Course(base, config or _configure(lesson.steps), report, fits=len(folds) + 1)
    examined = [
        examine(course.fit(fold.learn, number=i, phase="judging"), fold)
        for i, fold in enumerate(folds)
    ]
    evidence = _gather(folds, examined, rival=_meet(active, lesson, folds, examined))
    ruling = judge(evidence)
    whole = course.fit(blocks, number=len(folds), phase="fitting")
    metrics = _summarise(ruling, evidence, lesson)
    described = {
        "data": data_hash(list(lesson.clips)),
        "share": ruling.share,
        "finetuning": _describe(course.config),
        "bones": np.round(_measure_bones(lesson.clips), 4).tolist(),
    }
    scale = fit_scale(base.radius, [part.distances(ruling.share) for part in examined])
    if scale is not None:
        described["radius_scale"] = metrics["radius_scale"] = round(scale, 4)
    blob = dump_personal(
        blend(base.predictor.decoder, whole.decoder, ruling.share),
        described,
        base_sha256=base.sha256,
        familiarity=whole.familiarity,
    )
    return Learned(ruling.verdict, ruling.message, blob, metrics)


def learn_familiarity(predictor: Predictor, clips: Sequence[Clip]) -> Familiarity:
    """Remember what the windows of clips look like in the frozen latent."""
    observed = torch.from_numpy(cut_windows(clips, predictor.spec).observed)
    with torch.inference_mode():
        parts = [predictor.encode(part).z for part in observed.split(_ENCODE_BATCH)]
    return Familiarity.fit(torch.cat(parts).clone())


def _configure(steps: int | None) -> FinetuneConfig:
    return FinetuneConfig() if steps is None else FinetuneConfig(steps=steps)


def _load_active(lesson: Lesson) -> PersonalDecoder | None:
    """Build the active version, behind the encoder that it was fitted on."""
    if lesson.active is None:
        return None
    base = load_checkpoint(lesson.active_base or lesson.base)
    return load_personal(lesson.active, base.predictor, base_sha256=base.sha256)


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


def _summarise(ruling: Ruling, evidence: Evidence, lesson: Lesson) -> dict[str, Any]:
    metrics: dict[str, Any] = {
        "frames": list(FRAMES),
        "blend": ruling.share,
        "clips": len(lesson.clips),
        "seen": evidence.like.summarise(ruling.share),
        "unseen": evidence.unlike.summarise(ruling.share),
        "blends": {
            str(share): {
                "seen": round(evidence.like.compare(share).ratio, 4),
                "unseen": round(evidence.unlike.compare(share).ratio, 4),
            }
            for share in SHARES
        },
    }
    rival = evidence.rival
    if rival is not None:
        candidate = rival.candidate[SHARES.index(ruling.share)]
        metrics["new_trial"] = {
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
        f"{len(blocks)} stretches of motion of a second or more are too few to judge by; "
        f"record {MIN_BLOCKS} or more."
    )
