"""What the base gets wrong on a person, carried over to similar windows, in closed form.

No training: kernel ridge regression (the mean of a Gaussian process; Rasmussen and Williams 2006,
chapter 2) of the base's errors on the windows of a person's trials, in the few directions of the
frozen latent in which familiarity is measured. Far from all of these windows nothing is left of it,
so it needs no gate. It is exact after a fraction of a second, and a row of its own in the tables:
what a fitted decoder must be better than.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from models.data.clips import Clip
from models.data.windows import cut_windows
from models.familiarity import Familiarity
from models.predictor import Encoded, Predictor
from models.training.finetune import encode_windows

WIDTH, STRENGTH = 1.0, 1.0
"""Chosen on subject 7 of UTD-MHAD, see training/LOG.md; both are flat there."""


@dataclass(frozen=True, eq=False)
class KernelCorrection:
    """A base whose errors on one person are known; called like every forecaster.

    Attributes:
        base: the net.
        familiarity: of the person's windows, which are the centres of the kernel.
        coefficients: of each centre, for every coordinate of a forecast (normalised units, in
            canonical heading).
        width: of the kernel, in the distance of `familiarity`.
    """

    base: Predictor
    familiarity: Familiarity
    coefficients: Float64[Tensor, "point coordinate"]
    width: float

    @classmethod
    def fit(
        cls,
        base: Predictor,
        clips: Sequence[Clip],
        *,
        width: float = WIDTH,
        strength: float = STRENGTH,
    ) -> "KernelCorrection":
        """Solve for a person's clips.

        Args:
            base: the net whose errors these are.
            clips: of one person.
            width: of the kernel, in the distance of familiarity.
            strength: of the regularisation towards the base.

        Raises:
            ValueError: no clip is as long as a window.
        """
        cut = cut_windows(clips, base.spec)
        whole = torch.cat([torch.as_tensor(cut.observed), torch.as_tensor(cut.future)], dim=1)
        with torch.inference_mode():
            found = encode_windows(base, whole)
            moved = base.decoder(found.z, found.c, found.seed, horizon=base.spec.horizon)
            missed = (found.target / base.normalizer.scales[0] - moved).flatten(1).double()
            familiarity = Familiarity.fit(found.z)
            kernel = _compare(familiarity, found.z, width)
            centres = len(familiarity.points)
            normal = kernel.T @ kernel + strength * _compare_points(familiarity, width)
            jitter = 1e-6 * torch.eye(centres, dtype=torch.float64)
            coefficients = torch.linalg.solve(normal + jitter, kernel.T @ missed)
        return cls(base, familiarity, coefficients.clone(), width)

    def __call__(
        self, window: Float[Tensor, "batch observe joint 3"]
    ) -> Float[Tensor, "batch horizon joint 3"]:
        """Forecast the frames that follow each window: metres, in the frame of the input."""
        encoded = self.base.encode(window)
        moved = self._roll(encoded) + self._correct(encoded.z)
        return self.base.normalizer.from_net(moved, window, encoded.placement)

    def _roll(self, encoded: Encoded) -> Tensor:
        horizon = self.base.spec.horizon
        moved: Tensor = self.base.decoder(encoded.z, encoded.c, encoded.seed, horizon=horizon)
        return moved

    def _correct(self, z: Float[Tensor, "batch continuous"]) -> Tensor:
        spec = self.base.spec
        near = _compare(self.familiarity, z, self.width)
        return (near @ self.coefficients).float().view(len(z), spec.horizon, spec.joints, 3)


def _compare(
    familiarity: Familiarity, z: Float[Tensor, "window continuous"], width: float
) -> Float64[Tensor, "window point"]:
    """Give the Gaussian kernel between windows and the points of familiarity."""
    return _kernel((z - familiarity.mean) @ familiarity.axes, familiarity.points, width)


def _compare_points(familiarity: Familiarity, width: float) -> Float64[Tensor, "point point"]:
    return _kernel(familiarity.points, familiarity.points, width)


def _kernel(one: Tensor, other: Tensor, width: float) -> Float64[Tensor, "one other"]:
    apart = torch.cdist(one.double(), other.double()).square() / one.shape[1]
    return torch.exp(apart / (-2 * width**2))
