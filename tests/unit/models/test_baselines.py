from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.studies.elsewhere import ELSEWHERE
from models.baselines import DampedVelocity, Forecaster, Ridge, ZeroVelocity
from models.data.clips import Clip, load_clips
from models.data.splits import PERSONAL_TRIAL, TEST_TRIALS, TRAIN_SUBJECTS, select
from models.data.synthetic import synthetic_clips
from models.data.windows import Windows, cut_windows
from models.metrics import Scores, bootstrap_ratio, evaluate_forecasts, squared_errors_cm2
from models.spec import MotionSpec

SPEC = MotionSpec()


@pytest.fixture(scope="module")
def people() -> list[Clip]:
    return synthetic_clips(
        4, seed=5, actions=("reach", "wave", "walk_in_place"), takes=3, seconds=2.4, noise=False
    )


@pytest.fixture(scope="module")
def ridge(people: list[Clip]) -> Ridge:
    clips = select(people, subjects=("1", "2", "3"))
    return Ridge.fit(cut_windows(clips, SPEC, stride=2), clips=clips)


def score(forecaster: Forecaster, windows: Windows) -> Scores:
    forecast = forecaster(torch.from_numpy(windows.observed))
    return evaluate_forecasts(forecast.numpy(), windows.future)


@pytest.mark.parametrize("kind", [torch.float32, torch.float64, torch.float16])
def test_every_baseline_is_called_as_the_net_is(ridge: Ridge, kind: torch.dtype) -> None:
    window = torch.randn(3, 15, 20, 3).to(kind)
    for forecaster in (ZeroVelocity(), DampedVelocity(), ridge):
        forecast = forecaster(window)
        assert forecast.shape == (3, 15, 20, 3)
        assert forecast.dtype == torch.float32
        assert torch.isfinite(forecast).all()


def test_zero_velocity_repeats_the_last_pose() -> None:
    window = torch.randn(2, 15, 20, 3)
    assert torch.equal(ZeroVelocity(7)(window), window[:, -1:].expand(2, 7, 20, 3))


def test_damped_velocity_glides_to_a_halt() -> None:
    window = torch.zeros(1, 15, 20, 3)
    window[:, -1, :, 0] = 0.1
    steps = DampedVelocity(15, 0.5)(window).diff(dim=1, prepend=window[:, -1:])[0, :, 0, 0]
    assert steps == pytest.approx([0.1 * 0.5**k for k in range(1, 16)], abs=1e-6)


def test_without_velocity_left_damped_is_zero_velocity() -> None:
    window = torch.randn(2, 15, 20, 3)
    assert torch.equal(DampedVelocity(15, 0.0)(window), ZeroVelocity()(window))
    with pytest.raises(ValueError, match="between 0 and 1"):
        DampedVelocity(15, 1.1)


def test_ridge_beats_zero_velocity_on_somebody_new(ridge: Ridge, people: list[Clip]) -> None:
    windows = cut_windows(select(people, subjects=("4",)), SPEC)
    fitted, still = score(ridge, windows), score(ZeroVelocity(), windows)
    assert all(a < 0.8 * b for a, b in zip(fitted.mse_cm2, still.mse_cm2, strict=True))


def test_ridge_learns_a_person_in_closed_form(ridge: Ridge, people: list[Clip]) -> None:
    own = cut_windows(select(people, subjects=("4",), trials=("1",)), SPEC)
    later = cut_windows(select(people, subjects=("4",), trials=("2", "3")), SPEC)
    personal = ridge.personalize(own)
    assert score(personal, own).mse_cm2[-1] < 0.9 * score(ridge, own).mse_cm2[-1]
    assert score(personal, later).mse_cm2[-1] < score(ridge, later).mse_cm2[-1]


def test_an_endless_regularisation_leaves_the_base_as_it_is(
    ridge: Ridge, people: list[Clip]
) -> None:
    windows = cut_windows(select(people, subjects=("4",), trials=("1",)), SPEC)
    stiff = Ridge(ridge.weights, ridge.horizon, ridge.strength, adaptation=1e12)
    assert torch.allclose(stiff.personalize(windows).weights, ridge.weights, atol=1e-8)


def test_ridge_is_the_least_squares_solution(people: list[Clip]) -> None:
    clips = select(people, subjects=("1",), trials=("1",))
    windows = cut_windows(clips, SPEC, stride=4)
    fitted = Ridge.fit(windows, clips=clips, strengths=(0.01,), adaptations=(1.0,))
    observed = windows.observed.astype(np.float64)
    x = (observed - observed[:, -1:, 3:4]).reshape(len(windows), -1)
    x = np.concatenate([x, np.ones((len(x), 1))], axis=1)
    y = (windows.future - observed[:, -1:]).reshape(len(windows), -1)
    expected = np.linalg.solve(x.T @ x + 0.01 * len(x) * np.eye(x.shape[1]), x.T @ y)
    assert np.allclose(fitted.weights.numpy(), expected, atol=1e-8)


def test_ridge_does_not_care_where_people_stand(ridge: Ridge) -> None:
    window = torch.randn(2, 15, 20, 3, dtype=torch.float64)
    away = torch.tensor([1.0, -0.5, 2.0], dtype=torch.float64)
    assert torch.allclose(ridge(window + away), ridge(window) + away.float(), atol=1e-5)


def test_ridge_refuses_to_choose_with_one_person_and_other_windows(
    ridge: Ridge, people: list[Clip]
) -> None:
    clips = select(people, subjects=("1",))
    with pytest.raises(ValueError, match="at least two people"):
        Ridge.fit(cut_windows(clips, SPEC), clips=clips)
    with pytest.raises(ValueError, match="do not fit the weights"):
        ridge(torch.zeros(1, 10, 20, 3))


@pytest.mark.recordings
def test_ridge_comes_near_the_reference_figures(utd_mhad: Path) -> None:
    clips = load_clips(utd_mhad)
    training = select(clips, subjects=TRAIN_SUBJECTS)
    base = Ridge.fit(cut_windows(training, SPEC), clips=training)
    for subject, expected in ELSEWHERE["ridge"].items():
        own = cut_windows(select(clips, subjects=[subject], trials=[PERSONAL_TRIAL]), SPEC)
        test = cut_windows(select(clips, subjects=[subject], trials=TEST_TRIALS), SPEC)
        personal = base.personalize(own)
        before, after = score(base, test), score(personal, test)
        print(subject, base.strength, base.adaptation, before.mse_cm2, after.mse_cm2)
        assert before.mse_cm2 == pytest.approx(expected, rel=0.12)
        assert before.mse_cm2[-1] == pytest.approx(expected[-1], rel=0.05)
        assert after.mse_cm2 == pytest.approx(ELSEWHERE["ridge, personal"][subject], rel=0.08)
        window = torch.from_numpy(test.observed)
        errors = [
            squared_errors_cm2(forecaster(window).numpy(), test.future).mean(axis=1)
            for forecaster in (personal, base)
        ]
        assert bootstrap_ratio(errors[0], errors[1], test.clip).high < 0.95
