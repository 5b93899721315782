"""How much a window resembles what a personal version was trained on.

The encoder is shared and frozen, so its latent z is a fixed yardstick. A version keeps a few dozen
prototypes of its trials' windows; the distance of a window's z to the nearest of them, in units of
the spread of these windows, becomes the share that the personal decoder has in the forecast. The
rest is the base's: a decoder that was fitted to one motion says little about another.
"""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

PROTOTYPES = 96
NEAREST = 3
_ROUNDS = 12
_SNAP = 0.01


@dataclass(frozen=True, slots=True)
class FamiliarityRule:
    """Where the share falls from one to nothing; fixed on training subjects, see LOG.md.

    Attributes:
        half: distance at which the share is one half.
        width: how gently it falls.
    """

    half: float = 0.75
    width: float = 0.08


@dataclass(frozen=True, slots=True)
class Familiarity:
    """A compact model of a trial's windows in the latent.

    Attributes:
        mean: of the windows' z.
        spread: their standard deviation, by dimension.
        prototypes: standardised centres of the windows.
        rule: how distance becomes a share.
    """

    mean: Float[Tensor, " continuous"]
    spread: Float[Tensor, " continuous"]
    prototypes: Float[Tensor, "prototype continuous"]
    rule: FamiliarityRule = FamiliarityRule()

    @classmethod
    def fit(
        cls, z: Float[Tensor, "window continuous"], rule: FamiliarityRule | None = None
    ) -> "Familiarity":
        """Summarise the windows of a person's trials (deterministic k-means, farthest first).

        Raises:
            ValueError: no windows.
        """
        if not len(z):
            raise ValueError("familiarity needs at least one window")
        mean = z.mean(dim=0)
        spread = z.std(dim=0, correction=0).clamp_min(1e-3)
        return cls(mean, spread, _find_centres((z - mean) / spread), rule or FamiliarityRule())

    def distance(self, z: Float[Tensor, "window continuous"]) -> Float[Tensor, " window"]:
        """Root mean square distance per dimension to the nearest prototypes, averaged over them."""
        standard = (z - self.mean) / self.spread
        apart = torch.cdist(standard, self.prototypes) / standard.shape[1] ** 0.5
        nearest = apart.topk(min(NEAREST, apart.shape[1]), largest=False).values
        return torch.mean(nearest, dim=1)

    def share(self, z: Float[Tensor, "window continuous"]) -> Float[Tensor, " window"]:
        """Part of the personal decoder in each forecast, 0 to 1; far enough out exactly these."""
        share = torch.sigmoid((self.rule.half - self.distance(z)) / self.rule.width)
        return ((share - _SNAP) / (1 - 2 * _SNAP)).clamp(0, 1)

    def tensors(self) -> dict[str, Tensor]:
        """Give what a version's blob stores."""
        return {"mean": self.mean, "spread": self.spread, "prototypes": self.prototypes}

    def describe(self) -> dict[str, Any]:
        """Give what a version's metadata says."""
        return {"half": self.rule.half, "width": self.rule.width}

    @classmethod
    def restore(cls, tensors: dict[str, Tensor], described: dict[str, Any]) -> "Familiarity":
        """Rebuild from a blob."""
        return cls(**tensors, rule=FamiliarityRule(**described))


def _find_centres(points: Float[Tensor, "window continuous"]) -> Tensor:
    centres = _farthest_first(points, min(PROTOTYPES, len(points)))
    for _ in range(_ROUNDS):
        nearest = torch.cdist(points, centres).argmin(dim=1)
        counts = torch.bincount(nearest, minlength=len(centres)).clamp_min(1)
        sums = torch.zeros_like(centres).index_add_(0, nearest, points)
        centres = sums / counts[:, None]
    return centres


def _farthest_first(points: Tensor, count: int) -> Tensor:
    chosen = [int(points.square().sum(dim=1).argmin())]
    apart = torch.cdist(points, points[chosen]).squeeze(1)
    for _ in range(count - 1):
        chosen.append(int(apart.argmax()))
        apart = torch.minimum(apart, torch.cdist(points, points[chosen[-1:]]).squeeze(1))
    return points[chosen]
