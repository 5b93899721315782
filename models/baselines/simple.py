"""Forecasters without anything to fit, and what every forecaster looks like."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float, Float32
from torch import Tensor

DECAY = 0.6
"""Share of its velocity that a damped person keeps from frame to frame: on UTD-MHAD's subjects
1, 3, 5, 7 the best up to frame 10, and within 0.3 % of the best at frame 15. From 0.8 on it is
worse than zero velocity there."""


@runtime_checkable
class Forecaster(Protocol):
    """What the net and every baseline have in common."""

    def __call__(
        self, window: Float[Tensor, "batch observe joint xyz"]
    ) -> Float32[Tensor, "batch horizon joint xyz"]:
        """Forecast the frames that follow each window."""
        ...


@dataclass(frozen=True, slots=True)
class ZeroVelocity:
    """Nobody moves: the last pose, over and over."""

    horizon: int = 15

    def __call__(
        self, window: Float[Tensor, "batch observe joint xyz"]
    ) -> Float32[Tensor, "batch horizon joint xyz"]:
        """Repeat the last pose of each window."""
        return window[:, -1:].float().repeat(1, self.horizon, 1, 1)


@dataclass(frozen=True, slots=True)
class DampedVelocity:
    """Everybody glides to a halt: each frame keeps `decay` of the velocity of the one before.

    The velocity is that of the last two frames. With `decay` 0 it is zero velocity.

    Attributes:
        horizon: frames to forecast.
        decay: between 0 and 1.
    """

    horizon: int = 15
    decay: float = DECAY

    def __post_init__(self) -> None:
        """Refuse what would speed people up."""
        if not 0 <= self.decay <= 1:
            raise ValueError(f"decay must lie between 0 and 1, got {self.decay}")

    def __call__(
        self, window: Float[Tensor, "batch observe joint xyz"]
    ) -> Float32[Tensor, "batch horizon joint xyz"]:
        """Carry on with the last velocity, slowing down."""
        last, velocity = window[:, -1:].double(), (window[:, -1:] - window[:, -2:-1]).double()
        kept = self.decay ** torch.arange(1, self.horizon + 1, dtype=torch.float64)
        path = kept.to(window.device).cumsum(0)[None, :, None, None]
        return (last + path * velocity).float()
