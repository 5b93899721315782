"""Whether what was trained may answer, and how far: plain numbers in, a ruling and its reason out.

Two questions, asked of the candidate as it will be served, gate and correction included: does it
help on motion like that recorded, and does it not hurt on motion unlike it? The furthest reach
of the gate that passes both is taken. The clip is the unit, never the window: windows of a clip
overlap and say the same twice.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from app.domain.versions import Verdict
from models.metrics import FRAMES

BLEND = 0.85
"""How far the weights of a version are from the base's (0) to the fitted ones (1). All of the way
costs more on other motion than it brings on the recorded (docs/personalisation.md)."""
REACHES = (1.5, 1.3, 1.1, 0.9)
"""Distances from what was recorded at which a version has half of the share, the furthest first;
see `FamiliarityRule`. A nearer one gives up far less of the gain than a smaller blend does."""


@dataclass(frozen=True, slots=True)
class JudgeRule:
    """The constants; how each was chosen: docs/personalisation.md and LOG.md.

    Errors are those of the candidate as a part of the base's; standard errors are over clips.

    Attributes:
        usual: what versions of training subjects did on motion unlike the recorded, at the furthest
            reach, and
        usual_spread: how much that differed. A handful of clips says little by itself, so what was
            measured is weighed with this by its error (the mean of two normal distributions'
            product). Both are taken to shrink with the reach, see `_expect`.
        hurt_margin: how far above 1 that may come out.
        doubt: what standard errors are multiplied with on motion unlike the recorded: clips of the
            same motions agree with each other more than with the motions that will come. What is
            worse than 1 by more than that is never admitted.
        most_error: what a standard error on motion unlike the recorded counts as at most. So few
            clips that it is larger prove no harm, but what they show of it is not to help either:
            a tenth worse is never admitted.
        help_errors: how many standard errors above 1 everything that was left out may be together,
            at the best reach.
        like_errors: how many standard errors above 1, and
        like_margin: how much more, it may be on later parts of clips. They are weak witnesses: a
            gesture ends otherwise than it begins, and where the real gain was a third they said
            anything from a loss of a quarter to a gain of a third.
        trial_errors: how many standard errors below 1 it must be on whole trials left out.
        lose_errors: how many standard errors behind the active version a candidate may be on a
            trial that neither was trained on.
        lose_margin: and how far in any case. With one earlier trial both are the very same fit.
    """

    usual: float = 0.988
    usual_spread: float = 0.03
    hurt_margin: float = 0.005
    doubt: float = 2.0
    most_error: float = 0.05
    help_errors: float = 1.0
    like_errors: float = 2.0
    like_margin: float = 0.1
    trial_errors: float = 1.0
    lose_errors: float = 1.0
    lose_margin: float = 0.01


FEWEST_UNLIKE = 2
"""Clips of other motion without which nobody can say whether a candidate hurts there."""


@dataclass(frozen=True, eq=False)
class Figures:
    """Errors on clips that were left out, in cm², for each clip and reported frame.

    Attributes:
        before: of the base.
        after: of the candidate, for every one of `REACHES`.
    """

    before: Float[np.ndarray, "clip frame"]
    after: Float[np.ndarray, "reach clip frame"]

    def __len__(self) -> int:
        """Count the clips."""
        return len(self.before)

    def compare(self, reach: float) -> "Comparison":
        """Compare the candidate at a reach with the base, at the last frame."""
        return compare(self.before[:, -1], self.after[REACHES.index(reach), :, -1])

    def summarise(self, reach: float) -> dict[str, Any]:
        """Write the figures of a reach as they are stored with a version."""
        if not len(self):
            return {"clips": 0}
        after, found = self.after[REACHES.index(reach)], self.compare(reach)
        won = int((after[:, -1] < self.before[:, -1]).sum())
        return {
            "clips": len(self),
            "clips_won": won,
            "clips_lost": len(self) - won,
            "before_cm2": np.round(self.before.mean(axis=0), 3).tolist(),
            "after_cm2": np.round(after.mean(axis=0), 3).tolist(),
            "ratio": round(found.ratio, 4),
            "standard_error": round(found.error, 4) if np.isfinite(found.error) else None,
        }


@dataclass(frozen=True, slots=True)
class Comparison:
    """Mean error of one method as a part of another's, and its standard error over clips."""

    ratio: float
    error: float


@dataclass(frozen=True, eq=False)
class Rival:
    """The active version beside the candidate, on clips that neither was fitted on.

    Attributes:
        where: these clips, for people.
        base, active: their errors at the last frame, cm².
        candidate: of the candidate, for every one of `REACHES`.
    """

    base: Float[np.ndarray, " clip"]
    active: Float[np.ndarray, " clip"]
    candidate: Float[np.ndarray, "reach clip"]
    where: str = "the new trial"


@dataclass(frozen=True, eq=False)
class Evidence:
    """Everything that a ruling rests on.

    Attributes:
        like, unlike: on motion like and unlike what was learnt.
        trials: on every trial that was left out as a whole, by its name.
        rival: None where no active version was there, or no trial is new to it.
    """

    like: Figures
    unlike: Figures
    trials: dict[str, Figures]
    rival: Rival | None = None


@dataclass(frozen=True, slots=True)
class Ruling:
    """What becomes of a candidate.

    Attributes:
        verdict: whether it may answer.
        reach: of the gate that it is stored with, one of `REACHES`.
        message: why, for an operator.
    """

    verdict: Verdict
    reach: float
    message: str


def compare(before: Float[np.ndarray, " clip"], after: Float[np.ndarray, " clip"]) -> Comparison:
    """Give the ratio of two sums over clips, and its jackknife standard error.

    Of no clip at all nothing is known: 1, give or take anything.
    """
    if not len(before):
        return Comparison(1.0, float("inf"))
    ratio = float(after.sum() / max(before.sum(), 1e-9))
    count = len(before)
    if count < 2:
        return Comparison(ratio, float("inf"))
    others = (after.sum() - after) / np.maximum(before.sum() - before, 1e-9)
    spread = float(np.square(others - others.mean()).sum())
    return Comparison(ratio, float(np.sqrt((count - 1) / count * spread)))


def judge(evidence: Evidence, rule: JudgeRule | None = None) -> Ruling:
    """Rule on a candidate: promote it at the furthest reach that passes, or say what it failed."""
    rule = rule or JudgeRule()
    both = join([evidence.like, evidence.unlike])
    if not (np.isfinite(both.after).all() and np.isfinite(both.before).all()):
        return Ruling(
            Verdict.REJECT, REACHES[-1], "The fit went astray: its errors are not finite."
        )
    best = min(REACHES, key=lambda reach: both.compare(reach).ratio)
    found = both.compare(best)
    if not found.ratio - rule.help_errors * found.error < 1:
        told = _tell("clips and parts of clips left out", found)
        return _reject(evidence, best, f"It does not help: {told}.", rule)
    passed = [reach for reach in REACHES if _is_admissible(evidence, reach, rule)]
    if not passed:
        return _reject(evidence, best, _explain_failure(evidence, REACHES[-1]), rule)
    reach = passed[0]
    lost = _find_lost_trial(evidence, reach, rule)
    if lost is not None:
        return _reject(evidence, reach, lost, rule)
    return Ruling(Verdict.PROMOTE, reach, _explain_success(evidence, reach))


def _is_admissible(evidence: Evidence, reach: float, rule: JudgeRule) -> bool:
    like, unlike = evidence.like.compare(reach), evidence.unlike.compare(reach)
    if len(evidence.unlike) < FEWEST_UNLIKE:
        return False
    unsure = rule.doubt * min(unlike.error, rule.most_error)
    if not unlike.ratio - unsure <= 1 + rule.hurt_margin:
        return False
    if not _expect(unlike.ratio, unsure, reach, rule) <= 1 + rule.hurt_margin:
        return False
    if evidence.trials:
        return like.ratio < 1 - rule.trial_errors * like.error
    most = 1 + rule.like_margin + rule.like_errors * like.error
    return not len(evidence.like) or like.ratio <= most


def _expect(ratio: float, unsure: float, reach: float, rule: JudgeRule) -> float:
    """Weigh what was measured on motion unlike the recorded with what is usual there.

    What is usual is taken to grow with the third power of the reach; what was seen of it grew with
    a power of 1.4 to 2. So near the trials little is promised, and little feared.
    """
    part = (reach / REACHES[0]) ** 3
    usual = 1 - part * (1 - rule.usual)
    known, measured = (part * rule.usual_spread) ** 2, unsure**2
    return (measured * usual + known * ratio) / (measured + known)


def _explain_success(evidence: Evidence, reach: float) -> str:
    unlike = _percent(evidence.unlike.compare(reach))
    like = _percent(evidence.like.compare(reach))
    if evidence.trials:
        found = f"Whole trials left out: the error changes by {like}; other motion: {unlike}."
    else:
        found = (
            f"Motion left out altogether: the error changes by {unlike}; later parts of clips: "
            f"{like}. Another trial of the same motion will tell more."
        )
    return f"Good enough to answer, as far as {reach:.1f} from what was recorded. {found}"


def _explain_failure(evidence: Evidence, reach: float) -> str:
    unlike, like = evidence.unlike.compare(reach), evidence.like.compare(reach)
    if len(evidence.unlike) < FEWEST_UNLIKE:
        return "There is too little other motion to tell whether that would suffer; record more."
    return (
        f"Even as near as {reach:.1f} to what was recorded it is not good enough: on motion like "
        f"that the error changes by {_percent(like)}, on other motion by {_percent(unlike)}."
    )


def _find_lost_trial(evidence: Evidence, reach: float, rule: JudgeRule) -> str | None:
    """Say on which trial a candidate loses: against the base, or against the active version."""
    for name, figures in evidence.trials.items():
        found = figures.compare(reach)
        if found.ratio - rule.lose_errors * found.error > 1 + rule.lose_margin:
            return f"It loses on trial {name}, left out: {_percent(found)}."
    rival = evidence.rival
    if rival is not None:
        found = compare(rival.active, rival.candidate[REACHES.index(reach)])
        if found.ratio - rule.lose_errors * found.error > 1 + rule.lose_margin:
            return f"It loses against the active version on {rival.where}: {_percent(found)}."
    return None


def _reject(evidence: Evidence, reach: float, why: str, rule: JudgeRule) -> Ruling:
    """Reject; and where the active version does harm on new motion, take that back as well."""
    rival = evidence.rival
    if rival is not None:
        found = compare(rival.base, rival.active)
        if found.ratio - rule.lose_errors * found.error > 1 + rule.lose_margin:
            told = f"The active version does harm on {rival.where} ({_percent(found)})"
            return Ruling(Verdict.RETURN_TO_BASE, reach, f"{why} {told}: back to the base.")
    return Ruling(Verdict.REJECT, reach, why)


def _tell(where: str, found: Comparison) -> str:
    return f"on {where} the error changes by {_percent(found)}"


def _percent(found: Comparison) -> str:
    if not np.isfinite(found.error):
        return f"{found.ratio - 1:+.1%}"
    return f"{found.ratio - 1:+.1%} ± {found.error:.1%}"


def join(parts: Sequence[Figures]) -> Figures:
    """Put the figures of several folds together."""
    return Figures(
        before=np.concatenate([part.before for part in parts]),
        after=np.concatenate([part.after for part in parts], axis=1),
    )


def no_figures() -> Figures:
    """Give figures of no clip at all."""
    frames = len(FRAMES)
    return Figures(np.zeros((0, frames)), np.zeros((len(REACHES), 0, frames)))
