import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from models.baselines import DampedVelocity, ZeroVelocity
from models.data.clips import Clip
from models.data.windows import Windows, cut_windows
from models.metrics import bootstrap_ratio, evaluate_forecasts, squared_errors_cm2
from models.spec import MotionSpec
from models.training.bootstrap import ClipSums, bootstrap_ratios, clip_errors, join_clips

FRAMES = (2, 8)


def make_windows(clips: int = 5) -> Windows:
    random = np.random.default_rng(1)
    recorded = [
        Clip(
            random.normal(size=(33 + index, 20, 3)).cumsum(axis=0).astype(np.float32) / 50,
            subject="1",
            action="wave",
            trial="1",
            source="test",
        )
        for index in range(clips)
    ]
    return cut_windows(recorded, MotionSpec())


Case = tuple[int, int, float]
CASES = st.tuples(st.integers(1, 12), st.integers(0, 2**32 - 1), st.floats(0, 1))


def sums_of_two(case: Case) -> tuple[ClipSums, ClipSums]:
    """A candidate and a reference on so many clips, that differ from clip to clip by so much."""
    clips, seed, spread = case
    random = np.random.default_rng(seed)
    windows = random.integers(1, 50, size=clips)
    reference = random.gamma(2.0, size=(clips, 2)) + 1e-6
    factor = np.exp(random.normal(scale=spread, size=(clips, 2)))
    return ClipSums(reference * factor, windows, FRAMES), ClipSums(reference, windows, FRAMES)


def test_clip_sums_are_those_of_the_protocol() -> None:
    windows = make_windows()
    found = clip_errors(ZeroVelocity(), windows)
    forecast = np.repeat(windows.observed[:, -1:], 15, axis=1)
    assert found.sums.shape == (5, 6)
    assert found.windows.tolist() == [4, 5, 6, 7, 8]
    assert found.mse_cm2 == pytest.approx(evaluate_forecasts(forecast, windows.future).mse_cm2)
    own = windows.clip == 3
    only = evaluate_forecasts(forecast[own], windows.future[own])
    assert found.sums[3] / 7 == pytest.approx(only.mse_cm2)


def test_one_frame_is_compared_as_by_windows() -> None:
    windows = make_windows()
    errors = []
    for method in (DampedVelocity(), ZeroVelocity()):
        forecast = method(torch.as_tensor(windows.observed)).numpy()
        errors.append(squared_errors_cm2(forecast, windows.future)[:, :8].mean(axis=1))
    expected = bootstrap_ratio(errors[0], errors[1], windows.clip)
    sums = (clip_errors(method, windows) for method in (DampedVelocity(), ZeroVelocity()))
    found = bootstrap_ratios(*sums)[8]
    assert (found.value, found.low, found.high) == pytest.approx(
        (expected.value, expected.low, expected.high)
    )


@settings(max_examples=60, deadline=None)
@given(case=CASES)
def test_a_method_is_exactly_as_good_as_itself(case: Case) -> None:
    candidate, _ = sums_of_two(case)
    again = ClipSums(candidate.sums.copy(), candidate.windows, FRAMES)
    for ratio in bootstrap_ratios(candidate, again, draws=200).values():
        assert (ratio.value, ratio.low, ratio.high) == (1.0, 1.0, 1.0)


@settings(max_examples=60, deadline=None)
@given(case=CASES, factor=st.floats(0.1, 10))
def test_a_method_that_is_everywhere_so_much_worse_has_just_that_ratio(
    case: Case, factor: float
) -> None:
    _, reference = sums_of_two(case)
    worse = ClipSums(reference.sums * factor, reference.windows, FRAMES)
    for ratio in bootstrap_ratios(worse, reference, draws=200).values():
        assert (ratio.value, ratio.low, ratio.high) == pytest.approx((factor,) * 3)


@settings(max_examples=60, deadline=None)
@given(case=CASES)
def test_intervals_lie_within_the_ratios_of_clips_and_do_not_know_the_order_of_frames(
    case: Case,
) -> None:
    candidate, reference = sums_of_two(case)
    found = bootstrap_ratios(candidate, reference, draws=400)
    assert tuple(found) == FRAMES
    single = candidate.sums / reference.sums
    for column, ratio in enumerate(found.values()):
        least, most = single[:, column].min(), single[:, column].max()
        slack = 1e-9 * most
        assert least - slack <= ratio.low <= ratio.high <= most + slack
        assert least - slack <= ratio.value <= most + slack
    turned = bootstrap_ratios(
        ClipSums(candidate.sums[:, ::-1].copy(), candidate.windows, FRAMES[::-1]),
        ClipSums(reference.sums[:, ::-1].copy(), reference.windows, FRAMES[::-1]),
        draws=400,
    )
    assert turned[2].low == pytest.approx(found[2].low)


def test_with_many_clips_the_interval_holds_the_estimate() -> None:
    random = np.random.default_rng(0)
    reference = random.gamma(2.0, size=(80, 2))
    windows = np.full(80, 30)
    noisy = reference * np.exp(random.normal(scale=0.3, size=(80, 2)))
    ratios = bootstrap_ratios(
        ClipSums(noisy, windows, FRAMES), ClipSums(reference, windows, FRAMES)
    )
    for ratio in ratios.values():
        assert ratio.low < ratio.value < ratio.high
        assert 0.05 < ratio.high - ratio.low < 0.3


def test_the_same_seed_gives_the_same_interval() -> None:
    windows = make_windows()
    pair = clip_errors(DampedVelocity(), windows), clip_errors(ZeroVelocity(), windows)
    assert bootstrap_ratios(*pair, seed=3) == bootstrap_ratios(*pair, seed=3)
    assert bootstrap_ratios(*pair, seed=4) != bootstrap_ratios(*pair, seed=3)


def test_people_are_joined_and_other_windows_refused() -> None:
    windows = make_windows()
    sums = clip_errors(ZeroVelocity(), windows)
    joined = join_clips([sums, sums])
    assert joined.sums.shape == (10, 6)
    assert joined.mse_cm2 == pytest.approx(sums.mse_cm2)
    with pytest.raises(ValueError, match="same windows"):
        bootstrap_ratios(joined, sums)
    few = clip_errors(ZeroVelocity(), windows, frames=FRAMES)
    with pytest.raises(ValueError, match="same windows and frames"):
        bootstrap_ratios(few, sums)
    with pytest.raises(ValueError, match="same frames"):
        join_clips([few, sums])
    with pytest.raises(ValueError, match="same frames"):
        join_clips([])
