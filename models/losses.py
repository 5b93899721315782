"""The reconstruction objective."""

from jaxtyping import Float
from torch import Tensor

SQUARED_WEIGHT = 20.0


def reconstruction_loss(
    forecast: Float[Tensor, "batch horizon joint 3"], truth: Float[Tensor, "batch horizon joint 3"]
) -> Float[Tensor, ""]:
    """Mean joint distance, the same on frame differences, and the squared error that is scored.

    Both arguments in metres. Distances keep quiet joints honest and frame differences keep the
    motion smooth (both as in siMLPe, Guo et al. 2023); the squared term, weighted so that the three
    are of one size at Kinect scale, is the metric itself.
    """
    error = forecast - truth
    position: Tensor = error.norm(dim=-1).mean()
    motion: Tensor = error.diff(dim=1).norm(dim=-1).mean()
    return position + motion + SQUARED_WEIGHT * error.square().mean()
