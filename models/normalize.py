"""Raw window <-> what the net sees: one mirrored pair, saved with the weights.

The net should not have to learn where in the room a person stands or which way they face, so both
are taken out of the window before the net and put back after it: `Normalizer.place` finds the
`Placement` (origin and heading), `to_net` applies it, `from_net` undoes it.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from models.skeleton import HIP_CENTER, LEFT_HIP, LEFT_SHOULDER, RIGHT_HIP, RIGHT_SHOULDER

HEADING_FRAMES = 5
MIN_ACROSS_M = 0.05


@dataclass(frozen=True, slots=True)
class Placement:
    """Where a window stands and faces.

    Attributes:
        origin: last observed hip centre in metres, in the frame of the input, float64.
        rotation: turns the input's frame into the canonical one (about the vertical y axis).
    """

    origin: Float[Tensor, "batch 3"]
    rotation: Float[Tensor, "batch 3 3"]


class Normalizer(nn.Module):
    """Centre, turn and scale windows; the statistics are buffers and travel with the weights.

    The canonical frame has its origin in the last observed hip centre, y up, and the person's left
    side towards -x, as somebody who faces a Kinect stands. Positions are then standardised by the
    mean pose and one common standard deviation, so that directions keep their meaning; velocities
    and accelerations by one standard deviation each.
    """

    mean_pose: Tensor
    scales: Tensor

    def __init__(self, joints: int, *, canonical_heading: bool = True) -> None:
        super().__init__()
        self.canonical_heading = canonical_heading
        self.register_buffer("mean_pose", torch.zeros(joints, 3))
        self.register_buffer("scales", torch.ones(3))

    def place(self, window: Float[Tensor, "batch observe joint 3"]) -> Placement:
        """Find origin and heading of each window (metres, y up, right-handed)."""
        origin = window[:, -1, HIP_CENTER].double()
        if not self.canonical_heading:
            eye = torch.eye(3, device=window.device)
            return Placement(origin, eye.expand(len(window), 3, 3))
        return Placement(origin, heading_rotation(window))

    def to_net(
        self, window: Float[Tensor, "batch time joint 3"], placement: Placement
    ) -> Float[Tensor, "batch time joint 3"]:
        """Move a window (metres) into the canonical frame, in units of the common deviation.

        The origin is subtracted in float64: ten metres from the sensor a float32 coordinate is
        already a micrometre coarse, and differences of differences would feel it.
        """
        centred = (window.double() - placement.origin[:, None, None]).float()
        turned = centred @ placement.rotation.transpose(1, 2)[:, None]
        return (turned - self.mean_pose) / self.scales[0]

    def from_net(
        self,
        displacement: Float[Tensor, "batch horizon joint 3"],
        window: Float[Tensor, "batch observe joint 3"],
        placement: Placement,
    ) -> Float[Tensor, "batch horizon joint 3"]:
        """Turn displacements from the last observed pose back into absolute metres."""
        turned = (displacement * self.scales[0]) @ placement.rotation[:, None]
        return (window[:, -1:].double() + turned.double()).float()

    @torch.no_grad()
    def fit(self, windows: Float[Tensor, "batch observe joint 3"]) -> None:
        """Measure the mean pose and the three deviations on (augmented) training windows."""
        self.mean_pose.zero_()
        self.scales.fill_(1.0)
        poses = self.to_net(windows, self.place(windows))
        self.mean_pose.copy_(poses.mean(dim=(0, 1)))
        velocity = poses.diff(dim=1)
        deviations = [(poses - self.mean_pose).std(), velocity.std(), velocity.diff(dim=1).std()]
        position = deviations[0]
        self.scales.copy_(
            torch.stack([position, deviations[1] / position, deviations[2] / position])
        )


def heading_rotation(window: Float[Tensor, "batch observe joint 3"]) -> Float[Tensor, "batch 3 3"]:
    """Rotation about y that turns the line from right to left side (hips, shoulders) along -x.

    The line is averaged over the last frames because one frame of a depth sensor is noisy. A
    person who shows no such line (lying on the side) keeps the heading of the input.
    """
    recent = window[:, -HEADING_FRAMES:].float().mean(dim=1)
    across = (
        recent[:, LEFT_HIP]
        - recent[:, RIGHT_HIP]
        + recent[:, LEFT_SHOULDER]
        - recent[:, RIGHT_SHOULDER]
    )
    length = torch.hypot(across[:, 0], across[:, 2])
    seen = length > MIN_ACROSS_M
    safe = torch.where(seen, length, torch.ones_like(length))
    cos = torch.where(seen, -across[:, 0] / safe, torch.ones_like(length))
    sin = torch.where(seen, -across[:, 2] / safe, torch.zeros_like(length))
    zero, one = torch.zeros_like(cos), torch.ones_like(cos)
    rows = [cos, zero, sin, zero, one, zero, -sin, zero, cos]
    return torch.stack(rows, dim=-1).reshape(-1, 3, 3)
