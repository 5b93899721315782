"""The reconstruction objective, and what ties categories to actions."""

import torch
from jaxtyping import Float
from torch import Tensor

SQUARED_WEIGHT = 20.0
_LEAST_PROBABILITY = 1e-6


def distance_loss(
    forecast: Float[Tensor, "batch horizon joint 3"], truth: Float[Tensor, "batch horizon joint 3"]
) -> Float[Tensor, ""]:
    """Mean joint distance plus the same on frame differences (siMLPe's; Guo et al. 2023).

    Both arguments in metres. Distances keep quiet joints honest and frame differences, taken
    within the forecast, keep the motion smooth.
    """
    error = forecast - truth
    position: Tensor = error.norm(dim=-1).mean()
    motion: Tensor = error.diff(dim=1).norm(dim=-1).mean()
    return position + motion


def reconstruction_loss(
    forecast: Float[Tensor, "batch horizon joint 3"], truth: Float[Tensor, "batch horizon joint 3"]
) -> Float[Tensor, ""]:
    """Mean joint distance, the same on frame differences, and the squared error that is scored.

    Both arguments in metres. The squared term, weighted so that the three are of one size at Kinect
    scale, is the metric itself. Squared errors grow about as fast as time does, so frame k has the
    weight 1/k: otherwise the last frames alone would be learnt.
    """
    error = forecast - truth
    weight = 1 / torch.arange(1, error.shape[1] + 1, device=error.device)
    squared = error.square().mean(dim=(0, 2, 3)) * (weight / weight.mean())
    return distance_loss(forecast, truth) + SQUARED_WEIGHT * squared.mean()


def label_loss(
    c: Float[Tensor, "batch category"], labels: Float[Tensor, "batch label"]
) -> Float[Tensor, ""]:
    """Cross-entropy between the first categories and the actions that windows are labelled with.

    A blend of two windows has shares of two labels; a window without a label costs nothing, but
    counts in the mean. `c` holds probabilities.
    """
    told: Tensor = (labels * (c[:, : labels.shape[1]] + _LEAST_PROBABILITY).log()).sum(dim=-1)
    return -told.mean()
