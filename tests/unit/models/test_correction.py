"""The closed-form correction of the base."""

import copy
import math
from collections.abc import Sequence
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from models import correction as module
from models.baselines.closed_form import KernelCorrection
from models.checkpoint import SHIPPED, load_checkpoint
from models.correction import Correction
from models.data.clips import Clip
from models.data.synthetic import synthetic_clips
from models.data.windows import cut_windows
from models.familiarity import Familiarity, FamiliarityRule
from models.personal import PersonalDecoder
from models.predictor import Predictor
from models.training import finetune
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


COORDINATES = 12


def make_gate(count: int) -> Familiarity:
    return Familiarity.fit(torch.randn(count, 8, generator=torch.manual_seed(0)))


def test_what_was_missed_is_given_back_where_it_was_missed() -> None:
    z = torch.randn(40, 8, generator=torch.manual_seed(0))
    missed = z @ torch.randn(8, COORDINATES, generator=torch.manual_seed(1))
    gate = make_gate(40)
    found = Correction.fit(gate, z, missed, strength=1e-3)
    assert (found(gate.measure(z)) - missed).square().mean() < 0.05 * missed.square().mean()
    far = found(gate.measure(z + 100))
    assert far.abs().max() < 1e-6


def test_only_some_windows_of_a_long_recording_are_forecast(
    base: Predictor, takes: Sequence[Clip], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(finetune, "MOST_WINDOWS", 20)
    forecast: list[int] = []
    whole = finetune._find_missed

    def count(base: Predictor, encodings: finetune.Encodings) -> Tensor:
        forecast.append(len(encodings))
        return whole(base, encodings)

    monkeypatch.setattr(finetune, "_find_missed", count)
    gate, correction = finetune.learn_nearby(base, takes)
    assert forecast == [20]
    assert len(correction.coefficients) == len(gate.points) > 20


def test_long_recordings_are_thinned_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MOST_CENTRES", 10)
    z = torch.randn(50, 8, generator=torch.manual_seed(0))
    found = Correction.fit(make_gate(50), z, z @ torch.ones(8, COORDINATES))
    assert found.coefficients.shape[0] == 50
    assert (found.coefficients.abs().sum(dim=1) > 0).sum() <= 10


@given(points=st.integers(1, 30), width=st.floats(0.1, 3.0), part=st.floats(0, 1))
def test_a_correction_comes_back_as_it_was_stored(points: int, width: float, part: float) -> None:
    z = torch.randn(points, 8, generator=torch.manual_seed(points))
    gate = Familiarity.fit(z)
    made = replace(Correction.fit(gate, z, z @ torch.ones(8, COORDINATES)), width=width, part=part)
    again = Correction.restore(
        made.tensors(), made.describe(), points=points, coordinates=COORDINATES
    )
    assert torch.equal(again(gate.measure(z)), made(gate.measure(z)))
    assert again.part == part


@pytest.mark.parametrize(
    ("described", "points", "coordinates"),
    [
        ({"width": 1.0, "part": 0.4}, 6, COORDINATES),
        ({"width": 1.0, "part": 0.4}, 5, COORDINATES + 1),
        ({"width": 0.0, "part": 0.4}, 5, COORDINATES),
        ({"width": math.inf, "part": 0.4}, 5, COORDINATES),
        ({"width": 10**400, "part": 0.4}, 5, COORDINATES),
        ({"width": 1.0, "part": 1.5}, 5, COORDINATES),
    ],
)
def test_parts_that_do_not_fit_are_refused(
    described: dict[str, float], points: int, coordinates: int
) -> None:
    z = torch.randn(5, 8, generator=torch.manual_seed(0))
    made = Correction.fit(Familiarity.fit(z), z, z @ torch.ones(8, COORDINATES))
    with pytest.raises(ValueError, match=r"different sizes|impossible"):
        Correction.restore(made.tensors(), described, points=points, coordinates=coordinates)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
def test_only_half_precision_is_read_which_what_is_finite_stays_finite_in(
    dtype: torch.dtype,
) -> None:
    z = torch.randn(5, 8, generator=torch.manual_seed(0))
    made = Correction.fit(Familiarity.fit(z), z, z @ torch.ones(8, COORDINATES))
    stored = {name: tensor.to(dtype) for name, tensor in made.tensors().items()}
    with pytest.raises(ValueError, match="half precision"):
        Correction.restore(stored, made.describe(), points=5, coordinates=COORDINATES)


def test_a_version_gives_the_corrected_base_its_part(
    base: Predictor, correction: KernelCorrection, takes: Sequence[Clip]
) -> None:
    windows = torch.from_numpy(cut_windows(takes, base.spec).observed[::10])
    gate = replace(correction.familiarity, rule=FamiliarityRule(half=1e3))
    fitted = copy.deepcopy(base.decoder)
    for weight in fitted.parameters():
        weight.data.mul_(1.05)
    with torch.inference_mode():
        made = {
            part: PersonalDecoder(
                base, fitted, gate, {}, replace(correction.correction, part=part)
            )(windows)
            for part in (0.0, 0.4, 1.0)
        }
        alone = PersonalDecoder(base, fitted, gate, {})(windows)
        corrected = correction(windows)
    assert torch.allclose(made[0.0], alone, atol=1e-5)
    assert torch.allclose(made[1.0], corrected, atol=1e-5)
    assert torch.allclose(made[0.4], 0.6 * alone + 0.4 * corrected, atol=1e-5)


def test_a_correction_stands_on_windows_that_are_known(
    base: Predictor, correction: KernelCorrection
) -> None:
    with pytest.raises(ValueError, match="to stand on"):
        PersonalDecoder(base, base.decoder, None, {}, correction.correction)
