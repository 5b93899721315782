"""Augmentation on the fly: other bodies, other rooms, other sensors, other tempos.

Everything works on a batch of whole windows (observed and future frames together) in metres, y up,
so that a window and its truth change alike; only sensor noise touches the observed part alone.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from models.data.postures import assemble, change_posture, find_bones, scale_movement, travel
from models.normalize import heading_rotation
from models.skeleton import HIP_CENTER, KINECT_V1

_PARTS = ((5, 6, 7), (9, 10, 11), (13, 14, 15), (17, 18, 19), (0, 1, 4, 8))
_PART_OF_JOINT = [[float(joint in part) for joint in range(20)] for part in _PARTS]


@dataclass(frozen=True, slots=True)
class Augmentation:
    """How far each augmentation goes; 0 switches one off.

    Attributes:
        mirror: probability of swapping the sides of the body (x -> -x and left <-> right).
        yaw_rad: heading, uniform within plus or minus this.
        tilt_rad: tilt of the sensor about a random horizontal axis, normal with this deviation.
        scale: size of the person, uniform within 1 plus or minus this.
        bones: length of each bone (left and right alike), uniform within 1 plus or minus this.
        offset_m: constant offset of each joint, as between two makes of sensor, deviation.
        noise_m: white noise on observed joints, deviation; a third of the windows get it.
        still: probability of a person who holds still (with noise on the observed frames).
        tempo: speed of every other window, uniform within 1 plus or minus this, where the clip is
            long enough (applied when the window is cut).
        slow: probability of a speed between 0 and 1 instead (applied when the window is cut).
        reverse: probability of playing the window backwards.
        flicker: probability of parts of the body that the sensor does not see well: they wander or
            flip to and fro through the whole window, and nothing but their middle forecasts them.
        flicker_m: how far a part wanders in a frame, uniform up to this deviation.
        mix: probability of blending a window with another one of the batch, in canonical place and
            heading, by a uniform share (mixup, Zhang et al. 2018).
        posture: probability of the same movement from another posture, see `postures`.
        seated: part of those that sit.
        movement: probability of larger or smaller movements, see `postures`.
        travel: probability of moving through the room at a constant velocity, and of turning at a
            constant rate, see `postures`.
        speed_mps: of those who move, deviation of each horizontal direction.
        turn_radps: of those who turn, deviation.
    """

    mirror: float = 0.5
    yaw_rad: float = 0.1
    tilt_rad: float = 0.04
    scale: float = 0.1
    bones: float = 0.06
    offset_m: float = 0.003
    noise_m: float = 0.002
    still: float = 0.03
    tempo: float = 0.15
    slow: float = 0.12
    reverse: float = 0.0
    flicker: float = 0.25
    flicker_m: float = 0.012
    mix: float = 0.5
    posture: float = 0.3
    seated: float = 0.4
    movement: float = 0.08
    travel: float = 0.05
    speed_mps: float = 0.6
    turn_radps: float = 0.8


def augment(
    windows: Float[Tensor, "batch time joint 3"], config: Augmentation, *, observe: int
) -> Float[Tensor, "batch time joint 3"]:
    """Apply every augmentation with fresh random numbers of torch's global generator."""
    return augment_labelled(windows, windows.new_zeros(len(windows), 0), config, observe=observe)[0]


def augment_labelled(
    windows: Float[Tensor, "batch time joint 3"],
    labels: Float[Tensor, "batch label"],
    config: Augmentation,
    *,
    observe: int,
) -> tuple[Float[Tensor, "batch time joint 3"], Float[Tensor, "batch label"]]:
    """Apply every augmentation; where two windows are blended, so are their labels."""
    windows = _reverse(windows, config.reverse)
    windows = mirror(windows, chosen=_coin(windows, config.mirror))
    windows = _resize(windows, config)
    if max(config.mix, config.posture, config.movement, config.travel) > 0:
        windows = _place(windows, observe=observe)
    windows, labels = _mix(windows, labels, config.mix)
    windows = _retell(windows, config, observe=observe)
    windows = _turn(windows, config)
    windows = _flicker(windows, config)
    offset = torch.randn(len(windows), 1, windows.shape[2], 3, device=windows.device)
    windows = windows + config.offset_m * offset
    windows = torch.where(_coin(windows, config.still), windows[:, :1], windows)
    return _shake(windows, config, observe=observe), labels


def mirror(
    windows: Float[Tensor, "batch time joint 3"], *, chosen: Tensor | None = None
) -> Float[Tensor, "batch time joint 3"]:
    """Mirror the body: x -> -x *and* left joints <-> right joints (both, or it is no body)."""
    flipped = windows[:, :, list(KINECT_V1.mirror)] * windows.new_tensor([-1.0, 1.0, 1.0])
    return flipped if chosen is None else torch.where(chosen, flipped, windows)


def _coin(windows: Tensor, probability: float) -> Tensor:
    return torch.rand(len(windows), 1, 1, 1, device=windows.device) < probability


def _spread(count: int, around: float, device: torch.device) -> Tensor:
    return 1 + around * (2 * torch.rand(count, device=device) - 1)


def _reverse(windows: Tensor, probability: float) -> Tensor:
    if probability == 0.0:
        return windows
    return torch.where(_coin(windows, probability), windows.flip(1), windows)


def _resize(windows: Tensor, config: Augmentation) -> Tensor:
    """Rebuild the body from the hip centre outwards with other bone lengths."""
    pairs = torch.tensor(KINECT_V1.mirror, device=windows.device)
    joints = torch.arange(len(pairs), device=windows.device)
    bone = 1 + config.bones * (2 * torch.rand(len(windows), len(pairs), device=windows.device) - 1)
    bone = bone[:, torch.minimum(joints, pairs)]  # both sides alike
    bone = bone * _spread(len(windows), config.scale, windows.device)[:, None]
    return assemble(windows[:, :, HIP_CENTER], find_bones(windows) * bone[:, None, :, None])


def _place(windows: Tensor, *, observe: int) -> Tensor:
    """Put the last observed hip centre at the origin, and let everybody face the same way."""
    observed = windows[:, :observe]
    centred = windows - observed[:, -1:, HIP_CENTER : HIP_CENTER + 1]
    placed: Tensor = centred @ heading_rotation(observed).transpose(1, 2)[:, None]
    return placed


def _mix(windows: Tensor, labels: Tensor, probability: float) -> tuple[Tensor, Tensor]:
    """Blend pairs of people: between two motions lies a motion, and nobody's habits."""
    if probability == 0.0:
        return windows, labels
    partner = torch.randperm(len(windows), device=windows.device)
    share = torch.rand(len(windows), 1, 1, 1, device=windows.device)
    share = torch.where(_coin(windows, probability), share, torch.zeros_like(share))
    blended = windows + share * (windows[partner] - windows)
    return blended, labels + share[:, 0, 0] * (labels[partner] - labels)


def _retell(windows: Tensor, config: Augmentation, *, observe: int) -> Tensor:
    """Tell the same movement from other postures, in other sizes, and on the way through a room."""
    last = observe - 1
    windows = scale_movement(windows, probability=config.movement, last_observed=last)
    windows = change_posture(
        windows, probability=config.posture, seated=config.seated, last_observed=last
    )
    return travel(
        windows,
        probability=config.travel,
        speed_mps=config.speed_mps,
        turn_radps=config.turn_radps,
        last_observed=last,
    )


def _turn(windows: Tensor, config: Augmentation) -> Tensor:
    """Heading about y, then a tilt about a horizontal axis, both about the first hip centre."""
    count, device = len(windows), windows.device
    yaw = config.yaw_rad * (2 * torch.rand(count, device=device) - 1)
    tilt = config.tilt_rad * torch.randn(2, count, device=device)
    skew = torch.zeros(count, 3, 3, device=device)
    skew[:, 0, 2], skew[:, 2, 0] = yaw, -yaw
    skew[:, 1, 2], skew[:, 2, 1] = -tilt[0], tilt[0]
    skew[:, 0, 1], skew[:, 1, 0] = -tilt[1], tilt[1]
    rotation = torch.linalg.matrix_exp(skew)
    centre = windows[:, :1, HIP_CENTER : HIP_CENTER + 1]
    turned: Tensor = (windows - centre) @ rotation.transpose(1, 2)[:, None]
    return turned + centre


def _flicker(windows: Tensor, config: Augmentation) -> Tensor:
    """Let parts of the body wander: autoregressive noise, from flipping to a random walk."""
    if config.flicker == 0.0:
        return windows
    count, length = windows.shape[:2]
    device = windows.device
    keep = 1 - 1.7 * torch.rand(count, 1, 1, device=device)
    size = config.flicker_m * torch.rand(count, 1, 1, device=device)
    steps = torch.randn(length, *windows[:, 0].shape, device=device) * size
    wander = [steps[0] / (1 - 0.9 * keep.abs())]  # about as far as it will have come
    for step in steps[1:]:
        wander.append(keep * wander[-1] + step)
    unseen = torch.rand(count, 1, len(_PARTS), device=device) < 0.4
    joints = unseen.float() @ torch.tensor(_PART_OF_JOINT, device=device)
    hit = joints[..., None] * _coin(windows, config.flicker)
    return windows + hit * torch.stack(wander, dim=1)


def _shake(windows: Tensor, config: Augmentation, *, observe: int) -> Tensor:
    noise = config.noise_m * torch.randn_like(windows[:, :observe])
    noisy = _coin(windows, 1 / 3)
    shaken = windows.clone()
    shaken[:, :observe] += torch.where(noisy, noise, torch.zeros_like(noise))
    return shaken
