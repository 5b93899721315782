"""What counts as a frame and as a window, and the checks that one frame has to pass."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from app.domain.errors import (
    BadFrameError,
    BadTimeUnitError,
    TimeNotIncreasingError,
    WrongJointCountError,
)
from app.live.guard import GuardRules
from app.settings import Settings

SNAP_S = 1e-6
"""Times this close are the same: near 1.7e9 s a float64 resolves 2.4e-7 s."""
ENOUGH_STEPS = 5
"""Steps of `t` from which its unit is judged."""


@dataclass(frozen=True, slots=True)
class WindowRules:
    """What counts as a window; see the settings of the same names.

    Attributes:
        neighbour_max_s: frames further apart than this leave a `gap`.
        missing_max_s: a joint missing for longer is listed in `filled`.
        complete_s: span at which a window is complete.
        gap_s: a longer hole empties the window.
        restart_s: `t` back by more than this is a new clock, by less a wrong frame.
        confidence_min: a joint below it is missing.
        unsure_below, unsure_share: this share of joints below this confidence is `low_confidence`.
        coordinate_max_m: largest coordinate that is taken for one.
        step_min_s, step_max_s: range of a median step that can be seconds.
    """

    neighbour_max_s: float = 0.1
    missing_max_s: float = 0.1
    complete_s: float = 0.45
    gap_s: float = 0.5
    restart_s: float = 1.0
    confidence_min: float = 0.3
    unsure_below: float = 0.5
    unsure_share: float = 0.25
    coordinate_max_m: float = 100.0
    step_min_s: float = 0.005
    step_max_s: float = 0.150
    guard: GuardRules = field(default_factory=GuardRules)

    @classmethod
    def from_settings(cls, settings: Settings) -> "WindowRules":
        """Take the rules from the service's settings."""
        return cls(
            neighbour_max_s=settings.neighbour_max_ms / 1e3,
            missing_max_s=settings.missing_max_ms / 1e3,
            complete_s=settings.window_min_s,
            gap_s=settings.gap_s,
            confidence_min=settings.confidence_min,
            coordinate_max_m=settings.coordinate_max_m,
            guard=GuardRules(
                torso_min_m=settings.torso_min_m,
                torso_max_m=settings.torso_max_m,
                frozen_poses=settings.frozen_poses,
            ),
        )


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


def check_times(t: Float[np.ndarray, " time"], frames: int, rules: WindowRules) -> None:
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
        if not rules.step_min_s <= step <= rules.step_max_s:
            raise BadTimeUnitError(f"The median step of t is {step:g}; it must be in seconds.")
