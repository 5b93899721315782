"""The closed-form correction of the base."""

from collections.abc import Sequence

import pytest
import torch

from models.checkpoint import SHIPPED, load_checkpoint
from models.correction import KernelCorrection
from models.data.clips import Clip
from models.data.synthetic import synthetic_clips
from models.data.windows import cut_windows
from models.predictor import Predictor
from models.training.evaluate import score_forecaster


@pytest.fixture(scope="module")
def base() -> Predictor:
    return load_checkpoint(SHIPPED).predictor


@pytest.fixture(scope="module")
def takes() -> Sequence[Clip]:
    return synthetic_clips(1, seed=3, actions=("wave", "squat"), takes=2, seconds=2.5)


@pytest.fixture(scope="module")
def correction(base: Predictor, takes: Sequence[Clip]) -> KernelCorrection:
    return KernelCorrection.fit(base, [clip for clip in takes if clip.trial == "1"])


def test_another_take_of_the_same_motion_gains(
    base: Predictor, correction: KernelCorrection, takes: Sequence[Clip]
) -> None:
    windows = cut_windows([clip for clip in takes if clip.trial == "2"], base.spec)
    before, after = (score_forecaster(net, windows).mse_cm2[-1] for net in (base, correction))
    assert after < before


def test_where_nothing_is_similar_less_is_left_of_it(
    base: Predictor, correction: KernelCorrection, takes: Sequence[Clip]
) -> None:
    torch.manual_seed(0)
    own = torch.from_numpy(cut_windows(takes, base.spec).observed[::5])
    noise = own + 0.5 * torch.randn_like(own)
    with torch.inference_mode():
        moved = [(correction(window) - base(window)).abs().mean() for window in (own, noise)]
    assert moved[1] < moved[0] / 2


def test_a_strong_regularisation_gives_the_base(base: Predictor, takes: Sequence[Clip]) -> None:
    held = KernelCorrection.fit(base, takes, strength=1e12)
    window = torch.from_numpy(cut_windows(takes, base.spec).observed[::20])
    with torch.inference_mode():
        assert torch.allclose(held(window), base(window), atol=1e-5)


def test_clips_shorter_than_a_window_are_refused(base: Predictor, takes: Sequence[Clip]) -> None:
    short = [Clip(takes[0].poses[:20], "1", "wave", "1", "synthetic")]
    with pytest.raises(ValueError, match="window"):
        KernelCorrection.fit(base, short)
