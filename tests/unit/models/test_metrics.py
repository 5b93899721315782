from pathlib import Path

import numpy as np
import pytest

from models.data.clips import load_clips
from models.data.splits import TEST_TRIALS
from models.data.windows import cut_windows
from models.metrics import (
    FRAMES,
    Ratio,
    bootstrap_ratio,
    errors_per_clip,
    evaluate_forecasts,
    squared_errors_cm2,
)
from models.spec import MotionSpec

ZERO_VELOCITY = {
    "2": (11.31, 27.58, 67.11, 86.38, 112.37, 127.52),
    "4": (13.36, 32.72, 77.78, 98.37, 124.32, 138.51),
    "6": (10.39, 25.65, 64.52, 84.94, 114.57, 133.16),
}


def shifted(per_frame_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Three windows whose forecast is off by so much in x, in each frame."""
    truth = np.zeros((3, 15, 20, 3), dtype=np.float32)
    prediction = truth.copy()
    prediction[..., 0] = per_frame_m[:, None]
    return prediction, truth


def test_errors_are_per_coordinate_and_in_square_centimetres() -> None:
    prediction, truth = shifted(np.full(15, 0.1))
    errors = squared_errors_cm2(prediction, truth)
    assert errors.shape == (3, 15)
    assert errors == pytest.approx(100 / 3, rel=1e-6)


def test_the_error_at_a_frame_averages_over_the_frames_up_to_it() -> None:
    prediction, truth = shifted(np.sqrt(3 * np.arange(1, 16)) / 100)
    scores = evaluate_forecasts(prediction, truth)
    assert scores.frames == FRAMES
    assert scores.mse_cm2_at == pytest.approx(FRAMES, rel=1e-5)
    assert scores.mse_cm2 == pytest.approx([(k + 1) / 2 for k in FRAMES], rel=1e-5)


def test_the_mean_distance_is_in_millimetres() -> None:
    prediction, truth = shifted(np.arange(1, 16) / 100)
    assert evaluate_forecasts(prediction, truth).mpjpe_mm == pytest.approx(
        [10.0 * k for k in FRAMES]
    )


def test_no_windows_frames_out_of_reach_and_infinite_forecasts_are_refused() -> None:
    prediction, truth = shifted(np.zeros(15))
    with pytest.raises(ValueError, match="no windows"):
        evaluate_forecasts(prediction[:0], truth[:0])
    with pytest.raises(ValueError, match="horizon of 15"):
        evaluate_forecasts(prediction, truth, frames=(2, 16))
    prediction[0, 0, 0, 0] = np.inf
    with pytest.raises(ValueError, match="not finite"):
        evaluate_forecasts(prediction, truth)


def test_errors_are_gathered_by_clip() -> None:
    gathered = errors_per_clip(np.array([1.0, 3.0, 10.0]), np.array([4, 4, 9]))
    assert gathered.clips.tolist() == [4, 9]
    assert gathered.mean.tolist() == [2.0, 10.0]
    assert gathered.windows.tolist() == [2, 1]


def make_errors(clips: int, ratio: float, spread: float) -> tuple[np.ndarray, ...]:
    random = np.random.default_rng(0)
    clip = np.repeat(np.arange(clips), 20)
    reference = random.gamma(2.0, size=clips)[clip] * random.uniform(0.8, 1.2, size=len(clip))
    factor = ratio * np.exp(random.normal(0, spread, size=clips))[clip]
    return reference * factor, reference, clip


def test_a_steady_improvement_has_a_narrow_interval() -> None:
    result = bootstrap_ratio(*make_errors(60, 0.8, 0.01))
    assert 0.78 < result.low < result.value < result.high < 0.82


def test_an_improvement_in_few_clips_is_not_certain() -> None:
    result = bootstrap_ratio(*make_errors(8, 0.95, 0.5))
    assert result.low < 1 < result.high


def test_the_same_seed_gives_the_same_interval() -> None:
    errors = make_errors(20, 0.9, 0.2)
    first, again = bootstrap_ratio(*errors, seed=3), bootstrap_ratio(*errors, seed=3)
    assert first == again
    assert isinstance(first, Ratio)
    assert bootstrap_ratio(*errors, seed=4) != first
    narrow = bootstrap_ratio(*errors, seed=3, confidence=0.5)
    assert first.low < narrow.low < narrow.high < first.high


def test_ratios_that_mean_nothing_are_refused() -> None:
    one, clip = np.ones(2), np.array([0, 1])
    with pytest.raises(ValueError, match="no windows"):
        bootstrap_ratio(one[:0], one[:0], clip[:0])
    with pytest.raises(ValueError, match="without any error"):
        bootstrap_ratio(one, np.zeros(2), clip)
    with pytest.raises(ValueError, match="confidence"):
        bootstrap_ratio(one, one, clip, confidence=1.0)


@pytest.mark.recordings
@pytest.mark.parametrize("subject", sorted(ZERO_VELOCITY))
def test_zero_velocity_reproduces_the_published_protocol(subject: str, utd_mhad: Path) -> None:
    clips = load_clips(utd_mhad, subjects=[subject], trials=TEST_TRIALS)
    windows = cut_windows(clips, MotionSpec())
    still = np.repeat(windows.observed[:, -1:], 15, axis=1)
    scores = evaluate_forecasts(still, windows.future)
    for row in zip(scores.frames, scores.mse_cm2, scores.mse_cm2_at, scores.mpjpe_mm, strict=True):
        print(
            "subject {} frame {:2}: cumulative {:.2f}, at {:.2f} cm², {:.1f} mm".format(
                subject, *row
            )
        )
    assert scores.mse_cm2 == pytest.approx(ZERO_VELOCITY[subject], abs=0.01)
    assert {"2": 2399, "4": 2702, "6": 3916}[subject] == len(windows)
