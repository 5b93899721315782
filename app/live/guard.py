"""Whether what a stream sends is a person, and whether a forecast is possible.

What a body is like is in `app.domain.body`; here is what only windows and forecasts need.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from app.domain.body import (
    FACTS,
    GuardRules,
    is_stranger,
    judge_body,
    measure_body,
    measure_bones,
)
from models.skeleton import HIP_CENTER

__all__ = [
    "FACTS",
    "GuardRules",
    "Likeness",
    "is_possible",
    "judge_body",
    "measure_body",
    "moves_impossibly",
]
MEASURE_EVERY_S = 0.25


class Likeness:
    """Whether the body that a stream sees is the one that its weights were made for.

    Args:
        rules: the thresholds.

    Attributes:
        known: that body's bones, as `measure_bones` gives them; None if nobody knows.
    """

    def __init__(self, rules: GuardRules) -> None:
        self.known: Float[np.ndarray, "8"] | None = None
        self._rules = rules
        self.clear()

    def clear(self) -> None:
        """Forget who was seen."""
        self._is_stranger = False
        self._measured_t = -np.inf

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
        newest = float(times[-1])
        if self.known is None or newest - times[0] < self._rules.stranger_s:
            return False
        if newest - self._measured_t >= MEASURE_EVERY_S:
            first = int(np.searchsorted(times, newest - self._rules.stranger_s))
            bones = measure_bones(measure(first))
            self._is_stranger = is_stranger(bones, self.known, rules=self._rules)
            self._measured_t = newest
        return self._is_stranger


def moves_impossibly(
    window: Float[np.ndarray, "observe 20 3"], *, rate_hz: float, rules: GuardRules
) -> bool:
    """Tell whether a joint or the whole person jumps within the window."""
    steps = np.diff(window, axis=0) * rate_hz
    squared = np.einsum("tjc,tjc->tj", steps, steps)
    return bool(
        squared.max() > rules.joint_speed_max**2
        or squared[:, HIP_CENTER].max() > rules.root_speed_max**2
    )


def is_possible(
    displacement: Float[np.ndarray, "horizon 20 3"], *, rate_hz: float, rules: GuardRules
) -> bool:
    """Tell whether a forecast is finite and no joint of it is faster than any human's.

    Args:
        displacement: metres from the last observed pose.
        rate_hz: frames of the forecast per second.
        rules: the thresholds.
    """
    if not np.isfinite(displacement).all():
        return False
    steps = np.diff(displacement, axis=0, prepend=0.0) * rate_hz
    return bool(np.einsum("tjc,tjc->tj", steps, steps).max() <= rules.forecast_speed_max**2)
