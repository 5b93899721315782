"""How much a window resembles what a personal version was trained on.

The encoder is shared and frozen, so its latent z is a fixed yardstick. A version keeps the windows
of its trials as points in the few directions in which they differ most; the distance of a new
window to the nearest of them, in units of their spread, becomes the share that the person's version
has in the forecast. The rest is the base's: what was fitted to one motion says little about
another.
"""

from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

DIRECTIONS = 24
MOST_POINTS = 4096
"""More windows than this (two minutes of motion) are thinned out evenly."""
SNAP = 0.01
FURTHEST = 1000.0
"""No distance in units of a trial's spread is of use beyond."""


@dataclass(frozen=True, slots=True)
class FamiliarityRule:
    """Where the share falls from one to nothing; fixed on training subjects, see LOG.md.

    Attributes:
        half: distance at which the share is one half.
        width: how gently it falls.
    """

    half: float = 1.5
    width: float = 0.3


@dataclass(frozen=True, slots=True)
class Familiarity:
    """A compact model of a trial's windows in the latent.

    Attributes:
        mean: of the windows' z.
        axes: from z to the directions in which the windows differ most, each dimension of z
            weighted by the inverse of its spread.
        points: the windows, along these directions.
        rule: how distance becomes a share.
    """

    mean: Float[Tensor, " continuous"]
    axes: Float[Tensor, "continuous direction"]
    points: Float[Tensor, "point direction"]
    rule: FamiliarityRule = FamiliarityRule()

    @classmethod
    def fit(
        cls, z: Float[Tensor, "window continuous"], rule: FamiliarityRule | None = None
    ) -> "Familiarity":
        """Summarise the windows of a person's trials (principal components of the latent).

        Raises:
            ValueError: no windows.
        """
        if not len(z):
            raise ValueError("familiarity needs at least one window")
        mean = z.mean(dim=0)
        spread = z.std(dim=0, correction=0).clamp_min(1e-3)
        _, _, rows = torch.linalg.svd((z - mean) / spread, full_matrices=False)
        axes = rows[:DIRECTIONS].T / spread[:, None]
        points = ((z - mean) @ axes)[thin_out(len(z), MOST_POINTS)]
        return cls(mean, axes.contiguous(), points, rule or FamiliarityRule())

    def measure(self, z: Float[Tensor, "window continuous"]) -> Float[Tensor, "window point"]:
        """Mean square distance, per direction, to each of the windows that it knows."""
        apart = torch.cdist((z - self.mean) @ self.axes, self.points)
        return apart.square() / self.points.shape[1]

    def measure_points(self) -> Float[Tensor, "point point"]:
        """Mean square distance, per direction, between the windows that it knows."""
        return torch.cdist(self.points, self.points).square() / self.points.shape[1]

    def distance(self, z: Float[Tensor, "window continuous"]) -> Float[Tensor, " window"]:
        """Root mean square distance, per direction, to the nearest of the windows."""
        return self.measure(z).min(dim=1).values.sqrt()

    def share(self, z: Float[Tensor, "window continuous"]) -> Float[Tensor, " window"]:
        """Part of the person's version in each forecast, 0 to 1; far enough out exactly these."""
        share = torch.sigmoid((self.rule.half - self.distance(z)) / self.rule.width)
        return ((share - SNAP) / (1 - 2 * SNAP)).clamp(0, 1)

    def reaching(self, half: float) -> "Familiarity":
        """Give the same with another distance at which the share is one half."""
        return replace(self, rule=replace(self.rule, half=half))

    def tensors(self) -> dict[str, Tensor]:
        """Give what a version's blob stores."""
        return {"mean": self.mean, "axes": self.axes, "points": self.points}

    def describe(self) -> dict[str, Any]:
        """Give what a version's metadata says."""
        return {"half": self.rule.half, "width": self.rule.width}

    @classmethod
    def restore(cls, tensors: dict[str, Tensor], described: dict[str, Any]) -> "Familiarity":
        """Rebuild from a blob.

        Raises:
            ValueError: tensors that do not belong together.
            KeyError: one is missing.
        """
        mean, axes, points = tensors["mean"], tensors["axes"], tensors["points"]
        if axes.ndim != 2 or mean.shape != axes.shape[:1] or points.shape[1:] != axes.shape[1:]:
            raise ValueError("its parts have different sizes")
        if not (1 <= len(points) <= MOST_POINTS and 1 <= axes.shape[1] <= DIRECTIONS):
            told = f"{len(points)} windows in {axes.shape[1]} directions"
            raise ValueError(f"it knows {told}; 1 to {MOST_POINTS} in 1 to {DIRECTIONS} may be")
        if {mean.dtype, axes.dtype, points.dtype} != {torch.float32}:
            raise ValueError("it is not in single precision")
        half, width = described["half"], described["width"]
        if not (0 <= half <= FURTHEST and 1 / FURTHEST <= width <= FURTHEST):
            raise ValueError(f"its rule is impossible: {described}")
        return cls(mean, axes, points, FamiliarityRule(**described))


def thin_out(count: int, most: int) -> Int[Tensor, " kept"]:
    """Choose at most so many of some, evenly."""
    return torch.linspace(0, count - 1, min(count, most)).round().long()
