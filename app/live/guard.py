"""Whether what a stream sends is a person, and whether a forecast is possible.

What a body is like is in `app.domain.body`; here is what only windows and forecasts need.
"""

import numpy as np
from jaxtyping import Float

from app.domain.body import FACTS, GuardRules, judge_body, measure_body
from models.skeleton import HIP_CENTER

__all__ = ["FACTS", "GuardRules", "is_possible", "judge_body", "measure_body", "moves_impossibly"]


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
