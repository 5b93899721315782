"""Whether what a stream sends is a person, and whether a forecast is possible.

What a body is like is in `app.domain.body`; here is what only windows and forecasts need.
"""

from collections import deque
from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Float32, Float64

from app.domain.body import (
    BODY_LINES,
    CUE_LIMIT,
    CUE_WEIGHTS,
    FACTS,
    GuardRules,
    is_stranger,
    judge_sums,
    measure_body,
    measure_bones,
)
from models.runtime.fused import KERNEL
from models.runtime.resample import find_fastest
from models.skeleton import HIP_CENTER

__all__ = [
    "FACTS",
    "GuardRules",
    "Likeness",
    "is_possible",
    "judge_sums",
    "measure_fastest",
    "moves_impossibly",
    "note_body",
]
MEASURE_EVERY_S = 0.25
IDLE_EVERY_S = 1.0
"""How often bodies are measured whose bones nobody knows: only to remember whose they are."""
SLACK_S = 1e-3


class Likeness:
    """Whether the body that a stream sees is the one that its weights were made for.

    Args:
        rules: the thresholds.

    Attributes:
        known: that body's bones, as `measure_bones` gives them; None if nobody knows.
        measured_t: when the body that is seen was last measured, on the client's clock.
    """

    def __init__(self, rules: GuardRules) -> None:
        self.known: Float[np.ndarray, "8"] | None = None
        self._rules = rules
        self._expected: tuple[float, ...] | None = None
        self._seen: deque[tuple[float, Float[np.ndarray, "8"]]] = deque()
        self.clear()

    @property
    def bones(self) -> Float[np.ndarray, "8"] | None:
        """The bones of whoever was seen in the second before `measured_t`."""
        return self._seen[-1][1] if self._seen else None

    def expect(self, bones: tuple[float, ...] | None) -> None:
        """Say whose body the weights were made for, None if nobody knows."""
        if bones is not self._expected:  # said again with every frame
            self._expected = bones
            self.known = None if bones is None else np.array(bones)

    def clear(self) -> None:
        """Forget who was seen."""
        self._is_stranger = False
        self.measured_t = -np.inf
        self._seen.clear()

    def look(
        self,
        times: Float[np.ndarray, " frames"],
        measure: Callable[[int], Float[np.ndarray, "recent 20 3"]],
    ) -> bool:
        """Tell whether the last second shows somebody else; measured a few times a second.

        Args:
            times: of all frames at hand, seconds.
            measure: gives the poses from a frame on, in the net's skeleton.
        """
        newest, rules = float(times[-1]), self._rules
        if newest - times[0] < rules.stranger_s:
            return False
        every_s = IDLE_EVERY_S if self.known is None else MEASURE_EVERY_S
        if newest - self.measured_t >= every_s - SLACK_S:
            first = int(np.searchsorted(times, newest - rules.stranger_s))
            self._remember(newest, measure_bones(measure(first)))
            self._is_stranger = self.known is not None and self._judge(self.known)
        return self._is_stranger

    def _remember(self, t: float, bones: Float[np.ndarray, "8"]) -> None:
        self.measured_t = t
        self._seen.append((t, bones))
        while t - self._seen[0][0] > self._rules.stranger_long_s - self._rules.stranger_s + SLACK_S:
            self._seen.popleft()

    def _judge(self, known: Float[np.ndarray, "8"]) -> bool:
        seconds = [bones for _, bones in self._seen]
        seen_s = self._seen[-1][0] - self._seen[0][0] + self._rules.stranger_s
        long = seen_s >= self._rules.stranger_long_s - 1.5 * MEASURE_EVERY_S
        return is_stranger(seconds, known, rules=self._rules, long=long)


def note_body(
    pose: Float[np.ndarray, "20 3"], facts: Float64[np.ndarray, "frames 4"], row: int
) -> None:
    """Fill a row with what `measure_body` gives: by the kernel where there is one."""
    if KERNEL is None:
        facts[row] = measure_body(pose)
        return
    given = np.ascontiguousarray(pose, np.float64)
    KERNEL.measure_body(given, BODY_LINES, CUE_WEIGHTS, CUE_LIMIT, facts, row)


def moves_impossibly(
    window: Float[np.ndarray, "observe 20 3"], *, rate_hz: float, rules: GuardRules
) -> bool:
    """Tell whether a joint or the whole person jumps within the window."""
    joint, root = find_fastest(window, root=HIP_CENTER)
    return (
        joint > (rules.joint_speed_max / rate_hz) ** 2
        or root > (rules.root_speed_max / rate_hz) ** 2
    )


def measure_fastest(displacement: Float32[np.ndarray, "horizon 20 3"]) -> float:
    """Give the largest squared step of any joint from frame to frame of a forecast.

    Args:
        displacement: metres from the last observed pose.

    Returns:
        Square metres; not a number where a coordinate is none.
    """
    steps = displacement.copy()
    with np.errstate(invalid="ignore", over="ignore"):
        steps[1:] -= displacement[:-1]
        return float(np.vecdot(steps, steps).max())


def is_possible(fastest: float, *, rate_hz: float, rules: GuardRules) -> bool:
    """Tell whether a forecast with this largest squared step (square metres) can be followed."""
    return fastest <= (rules.forecast_speed_max / rate_hz) ** 2
