"""What counts as a window, by rules that come from the settings."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Float64

from app.domain import frames
from app.domain.frames import (
    ENOUGH_STEPS,
    SNAP_S,
    STEP_MAX_S,
    STEP_MIN_S,
    check_confidence,
    check_joints,
)
from app.live.guard import GuardRules
from app.settings import Settings
from models.runtime.fused import KERNEL

__all__ = [
    "ENOUGH_STEPS",
    "SNAP_S",
    "WindowRules",
    "check_confidence",
    "check_joints",
    "check_times",
    "is_within",
]


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
    step_min_s: float = STEP_MIN_S
    step_max_s: float = STEP_MAX_S
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


def check_times(t: Float[np.ndarray, " time"], count: int, rules: WindowRules) -> None:
    """Check the times of a whole array by these rules; raises as `app.domain.frames` does."""
    frames.check_times(t, count, step_min_s=rules.step_min_s, step_max_s=rules.step_max_s)


def is_within(pose: Float64[np.ndarray, "joint 3"], limit: float) -> bool:
    """Tell whether every coordinate is a number up to `limit`: by the kernel where there is one."""
    if KERNEL is None:
        return frames.is_within(pose, limit)
    found: bool = KERNEL.is_within(pose, limit)
    return found
