"""What was measured on a person: errors of methods on the same clips, as JSON keeps them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool

from models.baselines import Forecaster, ZeroVelocity
from models.data.clips import Clip
from models.data.windows import cut_windows
from models.metrics import FRAMES, Ratio
from models.spec import MotionSpec
from models.training.bootstrap import ClipSums, bootstrap_ratios, clip_errors, join_clips

_SPEC = MotionSpec()
_DIGITS = 6
LAST = FRAMES[-1]
Choose = Callable[[str, str], bool]
"""Whether to keep a clip, by its action and its trial."""


@dataclass(frozen=True, eq=False)
class Measured:
    """Errors of methods on the same clips.

    Attributes:
        actions, trials: of each clip that holds a window.
        sums: by method.
    """

    actions: tuple[str, ...]
    trials: tuple[str, ...]
    sums: Mapping[str, ClipSums]

    def pick(self, choose: Choose) -> "Measured":
        """Keep some clips."""
        pairs = zip(self.actions, self.trials, strict=True)
        chosen = np.array([choose(action, trial) for action, trial in pairs], dtype=bool)
        return Measured(
            _filter(self.actions, chosen),
            _filter(self.trials, chosen),
            {
                method: ClipSums(sums.sums[chosen], sums.windows[chosen], sums.frames)
                for method, sums in self.sums.items()
            },
        )

    def pick_action(self, wanted: str) -> "Measured":
        """Keep the clips of one action."""
        return self.pick(lambda action, _: action == wanted)

    def cm2(self, method: str) -> tuple[float, ...]:
        """Give the row of the table."""
        return self.sums[method].mse_cm2

    def compare(self, method: str, reference: str) -> dict[int, Ratio]:
        """Divide two methods' errors, by frame, with bootstrap intervals."""
        return bootstrap_ratios(self.sums[method], self.sums[reference])

    def ratio(self, method: str, reference: str, *, frame: int = LAST) -> float:
        """Divide two methods' errors at a frame."""
        at = FRAMES.index(frame)
        return self.cm2(method)[at] / self.cm2(reference)[at]

    def mean_ratio(self, method: str, reference: str) -> float:
        """Divide two methods' errors at every frame of the table, and take the mean."""
        return float(np.divide(self.cm2(method), self.cm2(reference)).mean())

    def as_json(self) -> dict[str, Any]:
        """Give what a row keeps."""
        windows = next(iter(self.sums.values())).windows
        return {
            "actions": list(self.actions),
            "trials": list(self.trials),
            "windows": windows.tolist(),
            "mean_cm2": {
                method: [[_round(value) for value in clip] for clip in _means(sums)]
                for method, sums in self.sums.items()
            },
        }

    @classmethod
    def from_json(cls, kept: Mapping[str, Any]) -> "Measured":
        """Read what a row keeps."""
        windows = np.array(kept["windows"], dtype=np.int64)
        return cls(
            tuple(kept["actions"]),
            tuple(kept["trials"]),
            {
                method: ClipSums(np.array(means) * windows[:, None], windows)
                for method, means in kept["mean_cm2"].items()
            },
        )


def measure(methods: Mapping[str, Forecaster], clips: Sequence[Clip]) -> Measured:
    """Measure methods on every window of some clips, and zero velocity beside them."""
    long = [clip for clip in clips if len(clip.poses) >= _SPEC.frames]
    windows = cut_windows(long, _SPEC)
    everything = {"zero_velocity": ZeroVelocity(_SPEC.horizon), **methods}
    sums = {name: clip_errors(forecaster, windows) for name, forecaster in everything.items()}
    return Measured(tuple(c.action for c in long), tuple(c.trial for c in long), sums)


def divide_by(
    found: Mapping[str, Measured], method: str, rows: Mapping[str, Sequence[float]]
) -> np.ndarray:
    """Divide a method's errors by rows that others measured; both by subject.

    Returns:
        [subject, frame] ratios, at the frames of the table.
    """
    return np.array([np.divide(one.cm2(method), rows[who]) for who, one in found.items()])


def join(parts: Sequence[Measured]) -> Measured:
    """Put what was measured on several people together."""
    methods = parts[0].sums
    return Measured(
        tuple(action for part in parts for action in part.actions),
        tuple(trial for part in parts for trial in part.trials),
        {method: join_clips([part.sums[method] for part in parts]) for method in methods},
    )


def average(parts: Sequence[Measured]) -> Measured:
    """Average the errors of several runs (seeds) on the same clips."""
    first = parts[0]
    sums = {
        method: ClipSums(
            np.mean([part.sums[method].sums for part in parts], axis=0), own.windows, own.frames
        )
        for method, own in first.sums.items()
    }
    return Measured(first.actions, first.trials, sums)


def _filter(names: Sequence[str], chosen: Bool[np.ndarray, " clip"]) -> tuple[str, ...]:
    return tuple(name for name, keep in zip(names, chosen, strict=True) if keep)


def _means(sums: ClipSums) -> list[list[float]]:
    means: list[list[float]] = (sums.sums / sums.windows[:, None]).tolist()
    return means


def _round(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")
