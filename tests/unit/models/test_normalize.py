import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from models.normalize import Normalizer, heading_rotation
from models.skeleton import LEFT_HIP, LEFT_SHOULDER, RIGHT_HIP, RIGHT_SHOULDER


def turn(angle: float) -> torch.Tensor:
    cos, sin = math.cos(angle), math.sin(angle)
    return torch.tensor([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])


def make_normalizer(windows: torch.Tensor) -> Normalizer:
    normalizer = Normalizer(20)
    normalizer.fit(windows)
    return normalizer


def test_what_goes_in_comes_out_again(windows: torch.Tensor) -> None:
    normalizer = make_normalizer(windows)
    observed, future = windows[:, :15], windows[:, 15:]
    placement = normalizer.place(observed)
    inside = normalizer.to_net(windows, placement)
    displacement = inside[:, 15:] - inside[:, 14:15]
    back = normalizer.from_net(displacement, observed, placement)
    assert torch.allclose(back, future, atol=1e-6)


def test_fitted_windows_have_zero_mean_and_unit_deviation(windows: torch.Tensor) -> None:
    normalizer = make_normalizer(windows)
    inside = normalizer.to_net(windows, normalizer.place(windows))
    assert inside.mean(dim=(0, 1)).abs().max() < 1e-4
    assert abs(float(inside.std()) - 1) < 0.01


@settings(max_examples=20, deadline=None)
@given(angle=st.floats(-3.1, 3.1), x=st.floats(-10, 10), z=st.floats(-10, 10))
def test_place_and_heading_of_a_person_do_not_reach_the_net(
    angle: float, x: float, z: float
) -> None:
    torch.manual_seed(1)
    windows = torch.randn(4, 15, 20, 3) * 0.3
    windows[:, :, [LEFT_HIP, LEFT_SHOULDER], 0] -= 1.0
    windows[:, :, [RIGHT_HIP, RIGHT_SHOULDER], 0] += 1.0
    normalizer = Normalizer(20)
    inside = normalizer.to_net(windows, normalizer.place(windows))
    moved = windows.double() @ turn(angle).double().T + torch.tensor([x, 0.5, z])
    again = normalizer.to_net(moved, normalizer.place(moved))
    assert torch.allclose(inside, again, atol=1e-4)


def test_the_left_side_is_turned_to_minus_x(windows: torch.Tensor) -> None:
    rotation = heading_rotation(windows)
    across = (windows[:, -5:, LEFT_SHOULDER] - windows[:, -5:, RIGHT_SHOULDER]).mean(1)
    turned = (rotation @ across[..., None]).squeeze(-1)
    assert (turned[:, 0] < 0).all()
    assert torch.allclose(torch.linalg.det(rotation), torch.ones(len(windows)), atol=1e-5)


def test_a_person_without_a_visible_heading_keeps_that_of_the_input() -> None:
    assert torch.equal(heading_rotation(torch.zeros(2, 15, 20, 3)), torch.eye(3).expand(2, 3, 3))


def test_heading_can_be_left_alone(windows: torch.Tensor) -> None:
    placement = Normalizer(20, canonical_heading=False).place(windows)
    assert torch.equal(placement.rotation, torch.eye(3).expand(len(windows), 3, 3))


@pytest.fixture
def windows(synthetic_windows: torch.Tensor) -> torch.Tensor:
    return synthetic_windows
