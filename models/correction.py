"""What the base gets wrong on a person, carried over to similar windows, in closed form.

No training: kernel ridge regression (the mean of a Gaussian process; Rasmussen and Williams 2006,
chapter 2) of the base's errors on the windows of a person's trials, in the few directions of the
frozen latent in which familiarity is measured. Far from all of these windows nothing is left of it.
It needs a fraction of the time of a fit, and it knows something that a fitted decoder does not, so
every version has a part of it; `baselines/closed_form.py` is what it does by itself.
"""

from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from models.familiarity import FURTHEST, Familiarity, thin_out

WIDTH, STRENGTH = 1.0, 1.0
"""Chosen on subject 7 of UTD-MHAD, see training/LOG.md; both are flat there."""
RANK = 32
"""Directions of a forecast in which it is kept; they hold all but half a percent of it."""
PART = 0.4
"""Of a version's forecast; the rest is the fitted decoder's. Chosen on subjects 3 and 7."""
MOST_CENTRES, MOST_WINDOWS = 2048, 8192
"""Of a long recording; with more, the equations would take longer than the fit beside them."""


@dataclass(frozen=True, slots=True)
class Correction:
    """The errors of a base near the windows of a person, as a sum of bumps around them.

    Attributes:
        coefficients: of the bump around each point of the person's familiarity.
        basis: what a coefficient stands for: displacements of all joints in all frames (normalised
            units, in canonical heading).
        width: of the bumps, in the distance of familiarity.
        part: that the corrected base has in the forecast of a version.
    """

    coefficients: Float[Tensor, "point rank"]
    basis: Float[Tensor, "rank coordinate"]
    width: float = WIDTH
    part: float = PART

    @classmethod
    def fit(
        cls,
        familiarity: Familiarity,
        z: Float[Tensor, "window continuous"],
        missed: Float[Tensor, "window coordinate"],
        *,
        width: float = WIDTH,
        strength: float = STRENGTH,
    ) -> "Correction":
        """Solve for what was missed on some windows; kept as 16 bits hold it.

        Args:
            familiarity: of these windows; the bumps stand around its points.
            z: of the windows, at most `MOST_WINDOWS`.
            missed: truth minus the base's forecast (normalised units).
            width: of the bumps, in the distance of familiarity.
            strength: of the regularisation towards the base.
        """
        centres = thin_out(len(familiarity.points), MOST_CENTRES)
        near = replace(familiarity, points=familiarity.points[centres])
        kernel = _bump(near.measure(z), width)
        missed = missed.double()
        overlap = kernel.T @ kernel
        jitter = 1e-6 * torch.eye(len(centres), dtype=torch.float64)
        normal = overlap + strength * _bump(near.measure_points(), width) + jitter
        solved = torch.linalg.solve(normal, kernel.T @ missed)
        basis = _find_directions(solved.T @ overlap @ solved)
        coefficients = torch.zeros(len(familiarity.points), len(basis), dtype=torch.float64)
        coefficients[centres] = solved @ basis.T
        return cls(_round(coefficients), _round(basis), width)

    def __call__(self, apart: Float[Tensor, "window point"]) -> Float[Tensor, "window coordinate"]:
        """Say what to add to the base's forecasts.

        Args:
            apart: squared distances of windows to the points, as `Familiarity.measure` gives them.
        """
        near = torch.exp(apart / (-2 * self.width**2))
        return near @ self.coefficients @ self.basis

    def tensors(self) -> dict[str, Tensor]:
        """Give what a version's blob stores; 16 bits lose nothing."""
        return {"coefficients": self.coefficients.half(), "basis": self.basis.half()}

    def describe(self) -> dict[str, Any]:
        """Give what a version's metadata says."""
        return {"width": self.width, "part": self.part}

    @classmethod
    def restore(
        cls, tensors: dict[str, Tensor], described: dict[str, Any], *, points: int, coordinates: int
    ) -> "Correction":
        """Rebuild from a blob.

        Args:
            tensors: as stored.
            described: the same.
            points: of the familiarity that it stands on.
            coordinates: of a forecast.

        Raises:
            ValueError: tensors that do not belong together.
            KeyError: one is missing.
        """
        stored = tensors["coefficients"], tensors["basis"]
        if {tensor.dtype for tensor in stored} != {torch.float16}:
            raise ValueError("it is not in half precision")
        coefficients, basis = (tensor.float() for tensor in stored)
        rank = len(basis)
        if coefficients.shape != (points, rank) or basis.shape != (rank, coordinates):
            raise ValueError("its parts have different sizes")
        if not 0 < rank <= RANK:
            raise ValueError(f"it has {rank} directions, at most {RANK} are known")
        if not (1 / FURTHEST <= described["width"] <= FURTHEST and 0 <= described["part"] <= 1):
            raise ValueError(f"its width or part is impossible: {described}")
        return cls(coefficients, basis, **described)


def _find_directions(
    square: Float64[Tensor, "coordinate coordinate"],
) -> Float64[Tensor, "rank coordinate"]:
    """Give the directions that say most, of a sum of outer products; as a basis."""
    directions: Tensor = torch.linalg.eigh(square)[1]
    return directions.flip(1)[:, :RANK].T


def _bump(apart: Float[Tensor, "one other"], width: float) -> Float64[Tensor, "one other"]:
    return torch.exp(apart.double() / (-2 * width**2))


def _round(values: Float64[Tensor, "..."]) -> Float[Tensor, "..."]:
    return values.half().float()
