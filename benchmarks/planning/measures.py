"""What many rounds come to: means over clips, differences between methods, bootstrap intervals."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from benchmarks.planning.rounds import Round

DRAWS = 2000
CONFIDENCE = 0.95
Value = Callable[[Round], float]


@dataclass(frozen=True)
class Measure:
    """A ratio of sums over rounds.

    Attributes:
        title: for the head of a table, with its unit.
        above, below: what is summed above and below the line.
        scale: what the ratio is multiplied by.
        digits: behind the point.
    """

    title: str
    above: Value
    below: Value
    scale: float = 1.0
    digits: int = 2


MEASURES: Mapping[str, Measure] = {
    "closest_cm": Measure("closest, cm", lambda r: r.closest_m, lambda _: 1.0, 100.0, 1),
    "too_close_s_per_min": Measure(
        "too close, s/min", lambda r: r.too_close_s, lambda r: r.seconds, 60.0
    ),
    "collisions_percent": Measure(
        "rounds with contact, %", lambda r: float(r.closest_m < 0), lambda _: 1.0, 100.0, 1
    ),
    "goals_per_min": Measure("goals/min", lambda r: r.goals, lambda r: r.seconds, 60.0, 1),
    "progress_m_per_s": Measure("progress, m/s", lambda r: r.progress_m, lambda r: r.seconds),
    "detour": Measure("path ÷ progress", lambda r: r.path_m, lambda r: r.progress_m),
    "changes_per_s": Measure("changes of plan/s", lambda r: r.changes, lambda r: r.seconds),
}


@dataclass(frozen=True)
class Estimate:
    """A figure with its interval."""

    value: float
    low: float
    high: float

    @property
    def is_clear(self) -> bool:
        """Whether the interval leaves 0 out."""
        return self.low > 0 or self.high < 0

    def tell(self, digits: int, *, sign: bool = False) -> str:
        """Write it."""
        form = f"{'+' if sign else ''}.{digits}f"
        return f"{self.value:{form}} ({self.low:{form}} to {self.high:{form}})"


@dataclass(frozen=True, eq=False)
class Tally:
    """One method's rounds, summed up by clip.

    Attributes:
        above, below: of each measure.
    """

    above: Float64[np.ndarray, "measure clip"]
    below: Float64[np.ndarray, "measure clip"]

    @classmethod
    def count(cls, clips: Sequence[Sequence[Round]]) -> "Tally":
        """Sum up the rounds of each clip."""
        measures = MEASURES.values()
        return cls(
            np.array([[sum(map(m.above, rounds)) for rounds in clips] for m in measures]),
            np.array([[sum(map(m.below, rounds)) for rounds in clips] for m in measures]),
        )

    def resample(
        self, draws: Float64[np.ndarray, "draw clip"]
    ) -> Float64[np.ndarray, "measure draw"]:
        """Give every measure of every draw of clips."""
        scales = np.array([measure.scale for measure in MEASURES.values()])[:, None]
        return np.asarray(scales * (self.above @ draws.T) / (self.below @ draws.T))


def draw_clips(count: int, *, seed: int = 0) -> Float64[np.ndarray, "draw clip"]:
    """Say how often each clip is in each draw; the first line has every clip once."""
    random = np.random.default_rng(seed)
    drawn = random.multinomial(count, np.full(count, 1 / count), size=DRAWS)
    return np.concatenate([np.ones((1, count)), drawn])


def estimate(tally: Tally, other: Tally | None = None) -> dict[str, Estimate]:
    """Give every measure of a method, or how much it differs from another on the same clips.

    A percentile bootstrap over clips, the same draws for both: clips are what was sampled; the two
    tasks of a clip, and its frames, are not independent.
    """
    draws = draw_clips(tally.above.shape[1])
    values = tally.resample(draws)
    if other is not None:
        values = values - other.resample(draws)
    tail = 50 * (1 - CONFIDENCE)
    low, high = np.percentile(values[:, 1:], [tail, 100 - tail], axis=1)
    rows = zip(MEASURES, values[:, 0], low, high, strict=True)
    return {name: Estimate(float(v), float(a), float(b)) for name, v, a, b in rows}
