"""Movement told from other postures, in other sizes, and on the way through a room."""

import pytest
import torch
from torch import Tensor

from models.data.postures import assemble, change_posture, find_bones, scale_movement, travel
from models.skeleton import HIP_CENTER

LAST = 14
_KNEES, _ANKLES = (13, 17), (14, 18)


@pytest.fixture
def windows(synthetic_windows: Tensor) -> Tensor:
    torch.manual_seed(0)
    return synthetic_windows - synthetic_windows[:, LAST : LAST + 1, HIP_CENTER : HIP_CENTER + 1]


def lengths(windows: Tensor) -> Tensor:
    return find_bones(windows).norm(dim=-1)


def test_bones_and_hips_make_the_body_again(windows: Tensor) -> None:
    again = assemble(windows[:, :, HIP_CENTER], find_bones(windows))
    assert torch.allclose(again, windows, atol=1e-6)


def test_another_posture_keeps_bones_hips_and_how_far_each_bone_turns(windows: Tensor) -> None:
    changed = change_posture(windows, probability=1.0, seated=0.0, last_observed=LAST)
    assert torch.allclose(lengths(changed), lengths(windows), atol=1e-5)
    assert torch.equal(changed[:, :, HIP_CENTER], windows[:, :, HIP_CENTER])
    swept = [find_bones(some).diff(dim=1).norm(dim=-1) for some in (changed, windows)]
    assert torch.allclose(*swept, atol=1e-5)
    apart = (find_bones(changed) - find_bones(windows)).norm(dim=-1)
    assert apart[:, :, [5, 9, 13, 17]].mean() > 0.05
    assert apart[:, :, [0, 1, 2]].mean() < 0.1


def test_who_sits_has_level_thighs_and_hanging_shins(windows: Tensor) -> None:
    changed = find_bones(change_posture(windows, probability=1.0, seated=1.0, last_observed=LAST))
    thighs, shins = changed[:, :, _KNEES], changed[:, :, _ANKLES]
    forward, up = -thighs[..., 2], thighs[..., 1]
    assert (forward > up.abs() * 0.3).float().mean() > 0.8
    assert (shins[..., 1] < -0.5 * shins.norm(dim=-1)).float().mean() > 0.8


def test_half_of_those_who_sit_hold_legs_and_hips_nearly_still(windows: Tensor) -> None:
    many = windows.repeat(20, 1, 1, 1)
    changed = change_posture(many, probability=1.0, seated=1.0, last_observed=LAST)
    moved = [find_bones(some)[:, :, _KNEES].std(dim=1).mean(dim=(1, 2)) for some in (changed, many)]
    calmed = moved[0] < 0.6 * moved[1]
    assert 0.3 < calmed.float().mean() < 0.7
    assert torch.allclose(changed[:, LAST, HIP_CENTER], many[:, LAST, HIP_CENTER], atol=1e-6)


def test_only_as_many_windows_as_wanted_are_told_anew(windows: Tensor) -> None:
    many = windows.repeat(40, 1, 1, 1)
    for told in (
        change_posture(many, probability=0.3, seated=0.5, last_observed=LAST),
        scale_movement(many, probability=0.3, last_observed=LAST),
    ):
        share = ((told - many).abs().amax(dim=(1, 2, 3)) > 1e-4).float().mean()
        assert 0.15 < share < 0.45


def test_larger_and_smaller_movements_keep_bones_and_the_last_place(windows: Tensor) -> None:
    changed = scale_movement(windows, probability=1.0, last_observed=LAST)
    assert torch.allclose(lengths(changed), lengths(windows), atol=1e-4)
    assert torch.allclose(changed[:, LAST, HIP_CENTER], windows[:, LAST, HIP_CENTER], atol=1e-6)
    swept = [find_bones(some).std(dim=1).mean(dim=(1, 2)) for some in (changed, windows)]
    ratio = swept[0] / swept[1]
    assert ratio.max() < 1.5
    assert ratio.min() < 0.8


def test_travelling_is_a_constant_velocity_on_top_and_keeps_the_last_observed_pose(
    windows: Tensor,
) -> None:
    moved = travel(windows, probability=1.0, speed_mps=0.6, turn_radps=0.0, last_observed=LAST)
    way = moved - windows
    assert way[:, LAST].abs().max() < 1e-6
    assert way[..., 1].abs().max() < 1e-6
    assert way.std(dim=2).max() < 1e-5
    assert way.diff(dim=1).std(dim=1).max() < 1e-5
    assert 0.2 < way[:, -1, 0].norm(dim=-1).mean() < 0.8  # half a second, both directions


def test_turning_keeps_distances_and_the_hips_of_who_stands(windows: Tensor) -> None:
    standing = windows - windows[:, :, HIP_CENTER : HIP_CENTER + 1]
    turned = travel(standing, probability=1.0, speed_mps=0.0, turn_radps=0.8, last_observed=LAST)
    assert torch.allclose(torch.cdist(turned, turned), torch.cdist(standing, standing), atol=1e-3)
    assert turned[:, :, HIP_CENTER].abs().max() < 1e-6
    assert (turned - standing)[:, LAST].abs().max() < 1e-6
    assert (turned - standing)[:, -1].norm(dim=-1).amax(dim=1).mean() > 0.02
