"""What a forecast is made of, free of torch so that the service's edge can read it."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class MotionSpec:
    """The shape of the task: how much is observed and how much is forecast.

    Attributes:
        joints: joints of the net's skeleton (20 for Kinect v1).
        rate_hz: frames per second of both the window and the forecast.
        observe: frames in the observed window.
        horizon: frames in the forecast.
    """

    joints: int = 20
    rate_hz: float = 30.0
    observe: int = 15
    horizon: int = 15

    def __post_init__(self) -> None:
        """Refuse shapes from which no velocity or acceleration can be taken."""
        if self.observe < 3:
            raise ValueError(f"observe must be at least 3 frames, got {self.observe}")
        if min(self.joints, self.horizon) < 1 or self.rate_hz <= 0:
            raise ValueError(f"joints, horizon and rate_hz must be positive: {self}")

    @property
    def frames(self) -> int:
        """Length of a training window: observed and forecast frames together."""
        return self.observe + self.horizon
