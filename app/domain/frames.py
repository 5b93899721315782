"""The checks that frames have to pass, one by one on a stream or all at once in an array."""

import numpy as np
from jaxtyping import Float

from app.domain.errors import (
    BadFrameError,
    BadTimeUnitError,
    TimeNotIncreasingError,
    WrongJointCountError,
)

SNAP_S = 1e-6
"""Times this close are the same: near 1.7e9 s a float64 resolves 2.4e-7 s."""
ENOUGH_STEPS = 5
"""Steps of `t` from which its unit is judged."""
STEP_MIN_S, STEP_MAX_S = 0.005, 0.150
"""Range of a median step that can be seconds."""


def check_joints(
    joints: Float[np.ndarray, "*time joint 3"], count: int, *, coordinate_max_m: float
) -> None:
    """Refuse another number of joints, and coordinates that cannot be metres.

    Raises:
        WrongJointCountError: not `count` joints.
        BadFrameError: an infinite coordinate, or one beyond `coordinate_max_m`.
    """
    if joints.shape[-2] != count:
        raise WrongJointCountError(f"{count} joints are expected, got {joints.shape[-2]}.")
    if not is_within(joints, coordinate_max_m) and (np.abs(joints) > coordinate_max_m).any():
        raise BadFrameError(
            f"A coordinate is infinite or beyond {coordinate_max_m:g} m. Are these metres?"
        )


def is_within(joints: Float[np.ndarray, "*time joint 3"], limit: float) -> bool:
    """Tell whether every coordinate is a number up to `limit`; NaN, a missing joint, is not."""
    return bool(joints.size and -limit <= joints.min() and joints.max() <= limit)


def check_confidence(confidence: Float[np.ndarray, "*time joint"], count: int) -> None:
    """Refuse confidences that are not one number from 0 to 1 for each joint.

    Raises:
        BadFrameError: another number of them, or one that is NaN or outside 0 … 1.
    """
    if confidence.shape[-1] != count:
        raise BadFrameError(f"{count} confidences are expected, got {confidence.shape[-1]}.")
    if not ((confidence >= -SNAP_S) & (confidence <= 1 + SNAP_S)).all():
        raise BadFrameError("A confidence must lie between 0 and 1.")


def check_times(
    t: Float[np.ndarray, " time"],
    frames: int,
    *,
    step_min_s: float = STEP_MIN_S,
    step_max_s: float = STEP_MAX_S,
) -> None:
    """Refuse times of a whole array that do not increase or are in another unit than seconds.

    Raises:
        BadFrameError: another number of them than frames, or one that is not finite.
        TimeNotIncreasingError: a time that is not above the one before it.
        BadTimeUnitError: a median step that no sensor has.
    """
    if len(t) != frames:
        raise BadFrameError(f"{len(t)} times for {frames} frames.")
    if not np.isfinite(t).all():
        raise BadFrameError("t must be finite numbers of seconds.")
    steps = np.diff(t)
    if (steps <= 0).any():
        first = int(np.argmax(steps <= 0))
        raise TimeNotIncreasingError(f"t[{first + 1}] must be above t[{first}].")
    if len(steps) >= ENOUGH_STEPS:
        step = float(np.median(steps))
        if not step_min_s <= step <= step_max_s:
            raise BadTimeUnitError(f"The median step of t is {step:g}; it must be in seconds.")
