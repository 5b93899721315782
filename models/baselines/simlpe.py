"""siMLPe, the peer: fully connected layers over time, in frequencies, and nothing else.

Written from its description (Guo et al., Back to MLP: A Simple Baseline for Human Motion
Prediction, WACV 2023), in sizes of this task: 15 frames in, 15 frames out, so that as many
frequencies as frames are enough. Poses go in without their place and scaled, not in raw metres.
"""

from dataclasses import asdict, dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32
from scipy.fft import dct
from torch import Tensor, nn

from models.normalize import Normalizer
from models.spec import MotionSpec

_FIRST_GAIN = 1e-8
"""Size of the first weights behind the way in: a fresh net says (nearly) zero velocity."""


@dataclass(frozen=True, slots=True)
class SimlpeSizes:
    """Sizes of the net; written into its file.

    Attributes:
        layers: blocks between the way in and the way out.
        canonical_heading: turn people to face one way first, see `Normalizer`; as published it does
            not, and it is better so (LOG.md).
    """

    layers: int = 48
    canonical_heading: bool = False


class Block(nn.Module):
    """One fully connected layer over frequencies, normalised over coordinates, as a residual."""

    def __init__(self, frequencies: int, coordinates: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(frequencies, frequencies))
        self.bias = nn.Parameter(torch.zeros(frequencies, 1))
        self.norm = nn.LayerNorm(coordinates)
        nn.init.xavier_uniform_(self.weight, gain=_FIRST_GAIN)

    def forward(
        self, spectrum: Float[Tensor, "frequency batch coordinate"]
    ) -> Float[Tensor, "frequency batch coordinate"]:
        """Mix frequencies, the same way for every coordinate."""
        mixed = torch.addmm(self.bias, self.weight, spectrum.flatten(1)).view_as(spectrum)
        added: Tensor = spectrum + self.norm(mixed)
        return added


class Simlpe(nn.Module):
    """Cosine transform over time, way in, blocks, way out, back, plus the last pose.

    Frequencies come first in every tensor, so that a layer is one matrix product and the
    normalisation is over the last axis. There is no activation: what is not linear is the
    normalisation of each block.
    """

    transform: Tensor

    def __init__(self, spec: MotionSpec | None = None, sizes: SimlpeSizes | None = None) -> None:
        super().__init__()
        self.spec = spec or MotionSpec()
        self.sizes = sizes or SimlpeSizes()
        frequencies, coordinates = self.spec.observe, self.spec.joints * 3
        if self.spec.horizon > frequencies:
            raise ValueError(f"{frequencies} frequencies do not give {self.spec.horizon} frames")
        self.normalizer = Normalizer(
            self.spec.joints, canonical_heading=self.sizes.canonical_heading
        )
        cosines = dct(np.eye(frequencies), type=2, norm="ortho", axis=0)
        self.register_buffer("transform", torch.tensor(cosines, dtype=torch.float32))
        self.enter = nn.Linear(coordinates, coordinates)
        self.blocks = nn.Sequential(
            *(Block(frequencies, coordinates) for _ in range(self.sizes.layers))
        )
        self.leave = nn.Linear(coordinates, coordinates)
        nn.init.xavier_uniform_(self.leave.weight, gain=_FIRST_GAIN)
        nn.init.zeros_(self.leave.bias)

    def forward(
        self, window: Float[Tensor, "batch observe joint 3"]
    ) -> Float32[Tensor, "batch horizon joint 3"]:
        """Forecast the next frames of each window (metres, y up, in the frame of the input).

        Raises:
            ValueError: the window has not the spec's number of frames or joints.
        """
        if window.shape[1:3] != (self.spec.observe, self.spec.joints):
            raise ValueError(
                f"a window has {self.spec.observe} frames of {self.spec.joints} joints, "
                f"got {tuple(window.shape[1:])}"
            )
        placement = self.normalizer.place(window)
        poses = self.normalizer.to_net(window, placement).flatten(2).transpose(0, 1)
        spectrum = self.enter(torch.tensordot(self.transform, poses, dims=1))
        spectrum = self.leave(self.blocks(spectrum))
        moved = torch.tensordot(self.transform.T[: self.spec.horizon], spectrum, dims=1)
        displacement = moved.transpose(0, 1).unflatten(2, (self.spec.joints, 3))
        return self.normalizer.from_net(displacement, window, placement)

    def describe(self) -> dict[str, object]:
        """Sizes and number of parameters, for metadata and logs."""
        count = sum(weight.numel() for weight in self.parameters())
        return {"spec": asdict(self.spec), "config": asdict(self.sizes), "parameters": count}
