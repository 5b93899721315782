from dataclasses import fields, replace

import pytest
import torch

from models.data.augment import Augmentation, augment, augment_labelled, mirror
from models.normalize import heading_rotation
from models.skeleton import HIP_CENTER, KINECT_V1, LEFT_HAND, RIGHT_HAND

OFF = Augmentation(**{field.name: 0.0 for field in fields(Augmentation)})


def bones(windows: torch.Tensor) -> torch.Tensor:
    child = [j for j, p in enumerate(KINECT_V1.parents) if p >= 0]
    parent = [KINECT_V1.parents[j] for j in child]
    return (windows[:, :, child] - windows[:, :, parent]).norm(dim=-1)


def test_nothing_switched_on_changes_nothing(synthetic_windows: torch.Tensor) -> None:
    assert torch.allclose(augment(synthetic_windows, OFF, observe=15), synthetic_windows, atol=1e-6)


def test_mirroring_swaps_the_sides_as_well(synthetic_windows: torch.Tensor) -> None:
    flipped = mirror(synthetic_windows)
    assert torch.equal(flipped[:, :, LEFT_HAND, 0], -synthetic_windows[:, :, RIGHT_HAND, 0])
    assert torch.equal(flipped[:, :, LEFT_HAND, 1:], synthetic_windows[:, :, RIGHT_HAND, 1:])
    assert torch.equal(mirror(flipped), synthetic_windows)


def test_other_bodies_keep_their_bones_and_their_symmetry(synthetic_windows: torch.Tensor) -> None:
    torch.manual_seed(0)
    changed = augment(synthetic_windows, replace(OFF, bones=0.2, scale=0.1), observe=15)
    ratio = bones(changed) / bones(synthetic_windows)
    assert ratio.std(dim=1).max() < 1e-4
    assert ratio[:, 0].std() > 0.05
    assert torch.allclose(ratio[..., 3:7], ratio[..., 7:11], atol=1e-3)
    assert torch.allclose(changed[:, :, HIP_CENTER], synthetic_windows[:, :, HIP_CENTER])


def test_turning_and_tilting_are_rigid(synthetic_windows: torch.Tensor) -> None:
    torch.manual_seed(0)
    changed = augment(synthetic_windows, replace(OFF, yaw_rad=3.0, tilt_rad=0.2), observe=15)
    assert torch.allclose(
        torch.cdist(changed, changed), torch.cdist(*[synthetic_windows] * 2), atol=1e-3
    )
    assert (changed - synthetic_windows).abs().max() > 0.1


def test_noise_touches_observed_frames_alone(synthetic_windows: torch.Tensor) -> None:
    torch.manual_seed(0)
    changed = augment(synthetic_windows, replace(OFF, noise_m=0.01), observe=15)
    moved = (changed - synthetic_windows).abs().amax(dim=(2, 3))
    assert moved[:, 15:].max() < 1e-5
    assert 0 < (moved[:, :15].amax(dim=1) > 1e-4).sum() < len(moved)


def test_offsets_are_constant_in_time(synthetic_windows: torch.Tensor) -> None:
    moved = augment(synthetic_windows, replace(OFF, offset_m=0.02), observe=15) - synthetic_windows
    assert moved.std(dim=1).max() < 1e-5
    assert moved[:, 0].std() > 0.01


@pytest.mark.parametrize(("field", "probability"), [("still", 1.0), ("reverse", 1.0)])
def test_still_and_reversed_windows(
    synthetic_windows: torch.Tensor, field: str, probability: float
) -> None:
    changed = augment(synthetic_windows, replace(OFF, **{field: probability}), observe=15)
    if field == "still":
        expected = synthetic_windows[:, :1].expand_as(synthetic_windows)
    else:
        expected = synthetic_windows.flip(1)
    assert torch.allclose(changed, expected, atol=1e-6)


def test_flickering_limbs_wander_and_the_trunk_stays(synthetic_windows: torch.Tensor) -> None:
    torch.manual_seed(0)
    changed = augment(synthetic_windows, replace(OFF, flicker=1.0, flicker_m=0.02), observe=15)
    moved = (changed - synthetic_windows).norm(dim=-1)
    assert moved[:, :, [2, HIP_CENTER, 12, 16]].max() < 1e-5
    limbs = moved[:, :, [7, 11, 15, 19, 0]].amax(dim=1) > 1e-4
    assert 0.2 < limbs.float().mean() < 0.6
    assert (limbs.any(dim=1) & ~limbs.all(dim=1)).any()


def test_blended_people_stand_between_two_of_the_batch(synthetic_windows: torch.Tensor) -> None:
    torch.manual_seed(0)
    blended = augment(synthetic_windows, replace(OFF, mix=1.0), observe=15)
    centre = blended[:, 14, HIP_CENTER]
    assert centre.abs().max() < 1e-5
    centred = synthetic_windows - synthetic_windows[:, 14:15, HIP_CENTER : HIP_CENTER + 1]
    placed = centred @ heading_rotation(synthetic_windows[:, :15]).transpose(1, 2)[:, None]
    assert (blended >= placed.amin(dim=0) - 1e-5).all()
    assert (blended <= placed.amax(dim=0) + 1e-5).all()
    assert (torch.cdist(blended.flatten(1), placed.flatten(1)).amin(dim=1) > 1e-3).any()


def test_labels_are_blended_as_the_windows_are(synthetic_windows: torch.Tensor) -> None:
    count = len(synthetic_windows)
    config, labels = replace(OFF, mix=0.5), torch.eye(count)
    torch.manual_seed(0)
    windows, blended = augment_labelled(synthetic_windows, labels, config, observe=15)
    torch.manual_seed(0)
    assert torch.equal(windows, augment(synthetic_windows, config, observe=15))
    assert torch.allclose(blended.sum(dim=1), torch.ones(count))
    kept = blended.diagonal() == 1
    assert kept.any()
    assert not kept.all()
    placed, _ = augment_labelled(synthetic_windows, labels, replace(OFF, mix=1e-9), observe=15)
    expected = torch.einsum("nm,mtjx->ntjx", blended, placed)
    assert torch.allclose(windows, expected, atol=1e-5)
