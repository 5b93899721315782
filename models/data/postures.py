"""Other postures, other sizes of movement, other ways through a room: motion retold by bones.

A few people who stand in front of a sensor show few postures, so a net learns that a bent knee is
about to be stretched. Here the same movement is retold from another posture (every bone turned by a
rotation of its own that stays the same through the window; often that of somebody seated whose legs
and hips hardly move), larger or smaller, or by somebody who moves through the room (a constant
velocity and turn on top: what an observer who glides past sees, Galilei's principle). The future is
retold like the past, so the truth stays consistent.

All windows are metres, y up, right-handed, heading canonical (see `normalize.heading_rotation`).
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from models.skeleton import HIP_CENTER, KINECT_V1, topological_levels

_TRUNK, _ROOTS, _LEGS = (2, 1, 0), (4, 8, 12, 16), (13, 14, 15, 17, 18, 19)
_WRIST_TO_HAND = ((6, 7), (10, 11))
_THIGH_SHIN_FOOT = ((13, 14, 15), (17, 18, 19))
_PARTS = ((0, 1, 2), (4, 5, 6, 7), (8, 9, 10, 11), (12, 13, 14, 15), (16, 17, 18, 19))
"""Bones, by their lower end, whose movement becomes larger or smaller together."""
_ROOT_SHARE = 0.2
_TRUNK_RAD, _SPINE_RAD = 0.15, 0.1
_TURN_RAD = 0.5
_LARGEST_MOVEMENT = 1.4
_CALM = 0.5
_FRAME_S = 1 / 30


def _make_matrices() -> tuple[Tensor, Tensor]:
    """Make what gives bones of joints, and joints (from the hip centre) of bones."""
    to_bones, from_bones = torch.eye(len(KINECT_V1.parents)), torch.eye(len(KINECT_V1.parents))
    for level in topological_levels(KINECT_V1.parents):
        for joint in level:
            parent = KINECT_V1.parents[joint]
            if parent < 0:
                to_bones[joint, joint] = from_bones[joint, joint] = 0.0
                continue
            to_bones[joint, parent] = -1.0
            from_bones[joint] += from_bones[parent]
    return to_bones, from_bones


_TO_BONES, _FROM_BONES = _make_matrices()


def _combine(
    matrix: Float[Tensor, "out joint"], windows: Float[Tensor, "batch time joint 3"]
) -> Float[Tensor, "batch time out 3"]:
    """Combine joints, several times as fast as picking each one's parent."""
    turned = windows.transpose(2, 3).contiguous()  # one product for all windows, not one for each
    mixed: Tensor = turned @ matrix.T.to(windows.device, windows.dtype)
    return mixed.transpose(2, 3).contiguous()


def find_bones(
    windows: Float[Tensor, "batch time joint 3"],
) -> Float[Tensor, "batch time joint 3"]:
    """Give the vector from each joint's parent to the joint; zero for the hip centre."""
    return _combine(_TO_BONES, windows)


def assemble(
    hips: Float[Tensor, "batch time 3"], bones: Float[Tensor, "batch time joint 3"]
) -> Float[Tensor, "batch time joint 3"]:
    """Build bodies from the hip centre outwards; the inverse of `find_bones`."""
    return hips[:, :, None] + _combine(_FROM_BONES, bones)


def change_posture(
    windows: Float[Tensor, "batch time joint 3"],
    *,
    probability: float,
    seated: float,
    last_observed: int,
) -> Float[Tensor, "batch time joint 3"]:
    """Retell some windows from other postures.

    Args:
        windows: metres, heading canonical.
        probability: of a window to be retold.
        seated: part of those that are retold as by somebody on a chair, half of whom hold legs and
            hips nearly still: their bones move towards the window's mean, which shortens those
            that turn far (of somebody who squats, by up to 8 %).
        last_observed: frame whose hips stay where they are.
    """
    if probability == 0.0:
        return windows
    count, device = len(windows), windows.device
    sits = torch.rand(count, device=device) < seated
    turns = _draw_turns(count, sits, device)
    bones = torch.einsum("njab,ntjb->ntja", _rotation(turns), find_bones(windows))
    still = sits & (torch.rand(count, device=device) < _CALM)
    left = torch.where(still, 0.5 * torch.rand(count, device=device), 1.0)
    bones[:, :, _LEGS] = _shrink(bones[:, :, _LEGS], left, bones[:, :, _LEGS].mean(1, keepdim=True))
    hips = windows[:, :, HIP_CENTER : HIP_CENTER + 1]
    hips = _shrink(hips, left, hips[:, last_observed : last_observed + 1])[:, :, 0]
    chosen = _choose(count, probability, device)
    return torch.where(chosen, assemble(hips, bones), windows)


def scale_movement(
    windows: Float[Tensor, "batch time joint 3"], *, probability: float, last_observed: int
) -> Float[Tensor, "batch time joint 3"]:
    """Make movements larger or smaller, in half of the windows each part of the body by itself.

    Directions of bones move away from, or towards, their mean within the window; lengths of bones
    stay. The hips move that much more or less from where they were observed last.
    """
    if probability == 0.0:
        return windows
    count, device = len(windows), windows.device
    each = _LARGEST_MOVEMENT * torch.rand(count, len(_PARTS), device=device)
    alike = torch.rand(count, 1, device=device) < 0.5
    each = torch.where(alike, each[:, :1], each)
    factor = torch.ones(count, windows.shape[2], device=device)
    for part, joints in enumerate(_PARTS):
        factor[:, joints] = each[:, part : part + 1]
    bones = find_bones(windows)
    length = bones.norm(dim=-1, keepdim=True)
    mean = bones.mean(1, keepdim=True)
    moved = mean + factor[:, None, :, None] * (bones - mean)
    moved = moved / moved.norm(dim=-1, keepdim=True).clamp(min=1e-4) * length
    hips = windows[:, :, HIP_CENTER]
    from_hips = hips[:, last_observed : last_observed + 1]
    hips = from_hips + each[:, :1, None] * (hips - from_hips)
    return torch.where(_choose(count, probability, device), assemble(hips, moved), windows)


def travel(
    windows: Float[Tensor, "batch time joint 3"],
    *,
    probability: float,
    speed_mps: float,
    turn_radps: float,
    last_observed: int,
) -> Float[Tensor, "batch time joint 3"]:
    """Let some people move through the room at a constant velocity, and some turn constantly.

    Args:
        windows: metres, heading canonical.
        probability: of a velocity, and by itself of a turn.
        speed_mps: standard deviation of both horizontal velocities.
        turn_radps: standard deviation of the rate of turn about the vertical through the hips.
        last_observed: frame that stays as it is.
    """
    if probability == 0.0:
        return windows
    count, device = len(windows), windows.device
    seconds = _FRAME_S * (torch.arange(windows.shape[1], device=device) - last_observed)
    rate = turn_radps * torch.randn(count, device=device)
    rate = rate * (torch.rand(count, device=device) < probability)
    angle = rate[:, None] * seconds
    cos, sin, zero = angle.cos(), angle.sin(), torch.zeros_like(angle)
    rows = [cos, zero, sin, zero, torch.ones_like(cos), zero, -sin, zero, cos]
    turn = torch.stack(rows, dim=-1).unflatten(-1, (3, 3))
    centre = windows[:, last_observed : last_observed + 1, HIP_CENTER : HIP_CENTER + 1]
    turned = (windows - centre) @ turn.transpose(2, 3) + centre
    velocity = torch.zeros(count, 3, device=device)
    velocity[:, ::2] = speed_mps * torch.randn(count, 2, device=device)
    velocity = velocity * (torch.rand(count, 1, device=device) < probability)
    way = velocity[:, None] * seconds[:, None]
    travelled: Tensor = turned + way[:, :, None]
    return travelled


def _draw_turns(
    count: int, sits: Bool[Tensor, " batch"], device: torch.device
) -> Float[Tensor, "batch joint 3"]:
    """Draw a rotation vector for every bone: of some size by chance, small within the trunk."""
    size = _TURN_RAD * torch.rand(count, 1, 1, device=device)
    turns = size * torch.randn(count, len(KINECT_V1.parents), 3, device=device)
    trunk = _TRUNK_RAD * torch.randn(count, 1, 3, device=device)
    bend = _SPINE_RAD * torch.randn(count, len(_TRUNK), 3, device=device)
    turns[:, _TRUNK] = trunk + bend
    turns[:, _ROOTS] *= _ROOT_SHARE
    for wrist, hand in _WRIST_TO_HAND:
        turns[:, hand] = turns[:, wrist] + 0.3 * turns[:, hand]
    thighs = torch.deg2rad(60 + 50 * torch.rand(count, device=device))  # from hanging to level
    shins = torch.deg2rad(50 * torch.rand(count, device=device) - 25)
    for thigh, shin, foot in _THIGH_SHIN_FOOT:
        apart = 0.15 * torch.randn(count, device=device)
        bent = 0.2 * torch.randn(2, count, 3, device=device)
        bent[0, :, 0], bent[1, :, 0] = thighs + apart, shins + apart
        for bone, turn in ((thigh, bent[0]), (shin, bent[1]), (foot, 0.5 * bent[1])):
            turns[:, bone] = torch.where(sits[:, None], turn, turns[:, bone])
    return turns


def _rotation(turns: Float[Tensor, "batch joint 3"]) -> Float[Tensor, "batch joint 3 3"]:
    """Make matrices of rotation vectors."""
    x, y, z = turns.unbind(-1)
    zero = torch.zeros_like(x)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
    rotations: Tensor = torch.linalg.matrix_exp(skew)
    return rotations


def _shrink(moving: Tensor, left: Float[Tensor, " batch"], around: Tensor) -> Tensor:
    shrunk: Tensor = around + left[:, None, None, None] * (moving - around)
    return shrunk


def _choose(count: int, probability: float, device: torch.device) -> Bool[Tensor, "batch 1 1 1"]:
    return torch.rand(count, 1, 1, 1, device=device) < probability
