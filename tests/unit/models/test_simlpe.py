import math

import pytest
import torch

from models.baselines import Forecaster, ZeroVelocity
from models.baselines.simlpe import Simlpe, SimlpeSizes
from models.spec import MotionSpec


def make_net(*, canonical_heading: bool = True) -> Simlpe:
    """A net whose weights are not nearly zero, as a fresh one's are."""
    torch.manual_seed(0)
    net = Simlpe(sizes=SimlpeSizes(layers=2, canonical_heading=canonical_heading))
    for weight in net.parameters():
        torch.nn.init.normal_(weight, std=0.2)
    return net.eval()


def turn(windows: torch.Tensor, angle: float) -> torch.Tensor:
    cos, sin = math.cos(angle), math.sin(angle)
    return windows @ torch.tensor([[cos, 0, -sin], [0, 1, 0], [sin, 0, cos]])


@pytest.fixture
def observed(synthetic_windows: torch.Tensor) -> torch.Tensor:
    return synthetic_windows[:, :15]


@torch.inference_mode()
def test_a_fresh_net_says_zero_velocity(observed: torch.Tensor) -> None:
    assert torch.allclose(Simlpe()(observed), ZeroVelocity()(observed), atol=1e-5)


@torch.inference_mode()
@pytest.mark.parametrize("kind", [torch.float32, torch.float64, torch.float16])
def test_it_is_called_as_the_net_is(kind: torch.dtype) -> None:
    net: Forecaster = make_net()
    forecast = net(torch.randn(3, 15, 20, 3).to(kind))
    assert forecast.shape == (3, 15, 20, 3)
    assert forecast.dtype == torch.float32


@torch.inference_mode()
def test_a_scene_that_is_moved_gives_a_forecast_moved_alike(observed: torch.Tensor) -> None:
    net, offset = make_net(), torch.tensor([3.0, -0.5, 8.0])
    assert torch.allclose(net(observed + offset), net(observed) + offset, atol=2e-5)


@torch.inference_mode()
def test_heading_matters_only_where_it_is_not_made_canonical(observed: torch.Tensor) -> None:
    turned = turn(observed, 0.7)
    apart = []
    for canonical in (True, False):
        net = make_net(canonical_heading=canonical)
        apart.append(float((net(turned) - turn(net(observed), 0.7)).abs().max()))
    assert apart[0] < 1e-4
    assert apart[1] > 1e-2


@torch.inference_mode()
def test_windows_of_a_batch_do_not_meet(observed: torch.Tensor) -> None:
    net = make_net()
    one_by_one = torch.cat([net(window[None]) for window in observed])
    assert torch.allclose(net(observed), one_by_one, atol=1e-5)


def test_the_transform_is_orthonormal_and_its_first_line_is_the_mean() -> None:
    transform = Simlpe().transform
    assert torch.allclose(transform @ transform.T, torch.eye(15), atol=1e-6)
    assert torch.allclose(transform[0], torch.full((15,), 15**-0.5))


def test_it_has_the_size_of_the_published_net_for_our_skeleton_and_window() -> None:
    layers, frames, coordinates = 48, 15, 60
    ends = 2 * (coordinates**2 + coordinates)
    blocks = layers * (frames**2 + frames + 2 * coordinates)
    assert Simlpe().describe()["parameters"] == ends + blocks == 24_600


def test_windows_and_tasks_of_another_shape_are_refused() -> None:
    with pytest.raises(ValueError, match="15 frames of 20 joints"):
        Simlpe()(torch.zeros(1, 14, 20, 3))
    with pytest.raises(ValueError, match="10 frequencies do not give 15 frames"):
        Simlpe(MotionSpec(observe=10))
