"""How good forecasts turn out to be, found out as the truth arrives frame by frame."""

from collections import deque
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from app.commands.figures import summarize

AHEAD = {0.1: 3, 0.2: 6, 0.5: 15}
"""Seconds ahead that are shown, and the forecast frame of each, counted from 1."""
REMEMBERED = 20_000
"""Measurements that are kept, the newest: eleven minutes at 30 Hz."""
RECENT = 90
HISTORY_S = 20
_CM_PER_M = 100.0


def mean_distance_cm(
    pose: Float[np.ndarray, "joint 3"], other: Float[np.ndarray, "joint 3"]
) -> float:
    """Mean distance of the joints of two poses (metres), in centimetres."""
    difference = pose.astype(np.float64) - other.astype(np.float64)
    return float(np.linalg.norm(difference, axis=1).mean() * _CM_PER_M)


@dataclass(slots=True)
class Errors:
    """Errors at one time ahead, of the forecast and of somebody who expects no motion, in cm."""

    forecast: deque[float] = field(default_factory=lambda: deque(maxlen=REMEMBERED))
    standing: deque[float] = field(default_factory=lambda: deque(maxlen=REMEMBERED))

    def add(self, forecast_cm: float, standing_cm: float) -> None:
        """Note one of each."""
        self.forecast.append(forecast_cm)
        self.standing.append(standing_cm)

    def mean(self, *, last: int = REMEMBERED) -> tuple[float, float]:
        """Mean of both over the last so many; NaN before the first."""
        if not self.forecast:
            return float("nan"), float("nan")
        kept = (list(self.forecast)[-last:], list(self.standing)[-last:])
        return float(np.mean(kept[0])), float(np.mean(kept[1]))


class Scores:
    """Compares the forecasts of one person with what came after.

    Attributes:
        errors: by seconds ahead.
        latencies_ms: from the moment at which a frame was due to its forecast.
    """

    def __init__(self) -> None:
        self.errors = {ahead: Errors() for ahead in AHEAD}
        self.latencies_ms: deque[float] = deque(maxlen=REMEMBERED)
        self._poses: dict[int, Float[np.ndarray, "joint 3"]] = {}
        self._open: deque[tuple[int, Float[np.ndarray, "horizon joint 3"]]] = deque(maxlen=64)

    def see(self, seq: int, pose: Float[np.ndarray, "joint 3"]) -> None:
        """Take the pose that was sent as frame `seq`, and judge forecasts that it completes."""
        self._poses[seq] = pose
        for old in [known for known in self._poses if known < seq - 3 * max(AHEAD.values())]:
            del self._poses[old]
        while self._open and self._open[0][0] + max(AHEAD.values()) <= seq:
            self._judge(*self._open.popleft())

    def foresee(
        self, seq: int, frames: Float[np.ndarray, "horizon joint 3"], *, latency_ms: float
    ) -> None:
        """Take the forecast that was made from frame `seq`."""
        self.latencies_ms.append(latency_ms)
        self._open.append((seq, frames))

    def forget(self) -> None:
        """Drop what cannot be judged any more: the frames that follow are of another stream."""
        self._poses.clear()
        self._open.clear()

    def list_history(self) -> tuple[list[float], list[float]]:
        """Give forecast and standing errors 0.5 s ahead, one mean per second, oldest first."""
        errors = self.errors[max(AHEAD)]
        both = []
        for values in (errors.forecast, errors.standing):
            newest = np.array(list(values)[-30 * HISTORY_S :])
            seconds = np.array_split(newest, max(1, len(newest) // 30)) if len(newest) else []
            both.append([float(second.mean()) for second in seconds])
        return both[0], both[1]

    def latency(self) -> tuple[float, float]:
        """Median and 99th percentile of the latency, in milliseconds."""
        spread = summarize(self.latencies_ms)
        return spread.median, spread.p99

    def _judge(self, seq: int, frames: Float[np.ndarray, "horizon joint 3"]) -> None:
        now = self._poses.get(seq)
        for ahead, frame in AHEAD.items():
            truth = self._poses.get(seq + frame)
            if now is not None and truth is not None:
                self.errors[ahead].add(
                    mean_distance_cm(frames[frame - 1], truth), mean_distance_cm(now, truth)
                )
