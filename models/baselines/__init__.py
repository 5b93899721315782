"""Baselines: forecasters to compare the net with, called exactly as the net is.

Each takes windows [batch, observe, joint, xyz] in absolute metres, of any float type, and returns
the frames that follow, [batch, horizon, joint, xyz], as float32 in the same frame of reference.
"""

from models.baselines.ridge import ADAPTATIONS, STRENGTHS, Ridge
from models.baselines.simple import DECAY, DampedVelocity, Forecaster, ZeroVelocity

__all__ = [
    "ADAPTATIONS",
    "DECAY",
    "STRENGTHS",
    "DampedVelocity",
    "Forecaster",
    "Ridge",
    "ZeroVelocity",
]
