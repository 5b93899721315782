from dataclasses import replace

import pytest
import torch

from models.data.augment import mirror
from models.losses import reconstruction_loss
from models.predictor import Predictor
from models.symmetry import Symmetry
from tests.nets import SMALL


@pytest.fixture
def lively() -> Predictor:
    """A net whose weights are all random, the output layer and the mean pose included."""
    torch.manual_seed(0)
    net = Predictor(config=SMALL)
    for parameter in net.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    net.normalizer.mean_pose.normal_(std=0.2)
    return net


def test_a_mirrored_window_gets_the_mirrored_forecast(
    lively: Predictor, synthetic_windows: torch.Tensor
) -> None:
    window = synthetic_windows[:, :15]
    assert (lively(mirror(window)) - mirror(lively(window))).abs().max() > 0.01
    Symmetry(lively).impose(lively)
    assert (lively(mirror(window)) - mirror(lively(window))).abs().max() < 1e-5
    assert (lively(window) - window[:, -1:]).abs().max() > 0.01


def test_symmetric_gradients_are_those_of_the_windows_and_their_mirror_images(
    lively: Predictor, synthetic_windows: torch.Tensor
) -> None:
    symmetry = Symmetry(lively)
    symmetry.impose(lively)
    both = torch.cat([synthetic_windows, mirror(synthetic_windows)])
    found = []
    for windows in (synthetic_windows, both):
        lively.zero_grad()
        reconstruction_loss(lively(windows[:, :15]), windows[:, 15:]).backward()
        if windows is synthetic_windows:
            symmetry.impose_on_gradients(lively)
        found.append([weight.grad.clone() for weight in lively.parameters()])
    assert all(torch.allclose(a, b, atol=1e-5) for a, b in zip(*found, strict=True))


def test_symmetric_weights_stay_as_they_are(lively: Predictor) -> None:
    symmetry = Symmetry(lively)
    symmetry.impose(lively)
    before = [weight.clone() for weight in lively.parameters()]
    symmetry.impose(lively)
    assert all(map(torch.equal, before, lively.parameters()))


def test_fresh_weights_keep_their_size() -> None:
    net = Predictor(config=SMALL)
    before = float(net.decoder.cell.weight_hh.detach().std())
    Symmetry(net).impose(net, is_fresh=True)
    assert abs(float(net.decoder.cell.weight_hh.detach().std()) / before - 1) < 0.1


def test_odd_sizes_have_no_halves() -> None:
    with pytest.raises(ValueError, match="no halves"):
        Symmetry(Predictor(config=replace(SMALL, spl_hidden=SMALL.spl_hidden + 1)))
    with pytest.raises(ValueError, match="even number of heads"):
        Symmetry(Predictor(config=replace(SMALL, encoder_heads=1)))
