"""The pinned protocol: errors of forecasts, and what can be said about their differences.

The protocol is the one that reproduces the zero-velocity row of the paper that Kinecast builds on:
windows of 30 frames at stride 1, 15 observed; absolute coordinates, no alignment, all joints; the
error at frame k is the mean of the squared error over windows, joints, coordinates and frames 1..k.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64, Int

FRAMES = (2, 4, 8, 10, 13, 15)
"""Forecast frames of the table, counted from 1, at 30 Hz."""
_CM2_PER_M2 = 1e4
_MM_PER_M = 1e3


@dataclass(frozen=True, slots=True)
class Scores:
    """Errors at the frames of the table.

    Attributes:
        frames: the forecast frames, counted from 1.
        mse_cm2: mean squared error per coordinate over the frames 1..k, in cm².
        mse_cm2_at: the same at frame k alone.
        mpjpe_mm: mean distance per joint at frame k, in mm.
    """

    frames: tuple[int, ...]
    mse_cm2: tuple[float, ...]
    mse_cm2_at: tuple[float, ...]
    mpjpe_mm: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Ratio:
    """A ratio of two mean errors with its bootstrap interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True, eq=False)
class ClipErrors:
    """Errors of each clip: `clips` [C] its index, `mean` [C] over its windows, `windows` [C]."""

    clips: Int[np.ndarray, " clip"]
    mean: Float64[np.ndarray, " clip"]
    windows: Int[np.ndarray, " clip"]


def squared_errors_cm2(
    prediction: Float[np.ndarray, "window horizon joint 3"],
    truth: Float[np.ndarray, "window horizon joint 3"],
) -> Float64[np.ndarray, "window horizon"]:
    """Squared error of each window and frame, mean over joints and coordinates, in cm².

    Both in metres, in the same frame of reference.
    """
    difference = prediction.astype(np.float64) - truth
    return np.asarray(np.mean(difference**2, axis=(2, 3)) * _CM2_PER_M2)


def evaluate_forecasts(
    prediction: Float[np.ndarray, "window horizon joint 3"],
    truth: Float[np.ndarray, "window horizon joint 3"],
    *,
    frames: tuple[int, ...] = FRAMES,
) -> Scores:
    """Score forecasts by the pinned protocol.

    Args:
        prediction: forecasts in metres.
        truth: what happened, in the same frame of reference.
        frames: forecast frames to report, counted from 1.

    Raises:
        ValueError: if there is no window, a frame lies beyond the horizon, or a forecast is not
            finite.
    """
    windows, horizon = prediction.shape[:2]
    if not windows:
        raise ValueError("there are no windows to score")
    if not frames or min(frames) < 1 or max(frames) > horizon:
        raise ValueError(f"frames {frames} do not lie within a horizon of {horizon}")
    if not np.isfinite(prediction).all():
        raise ValueError("a forecast is not finite")
    at = squared_errors_cm2(prediction, truth).mean(axis=0)
    cumulative = np.cumsum(at) / np.arange(1, horizon + 1)
    distance = np.linalg.norm(prediction.astype(np.float64) - truth, axis=-1).mean(axis=(0, 2))
    return Scores(
        frames=frames,
        mse_cm2=tuple(float(cumulative[k - 1]) for k in frames),
        mse_cm2_at=tuple(float(at[k - 1]) for k in frames),
        mpjpe_mm=tuple(float(distance[k - 1] * _MM_PER_M) for k in frames),
    )


def errors_per_clip(
    errors: Float[np.ndarray, " window"], clip: Int[np.ndarray, " window"]
) -> ClipErrors:
    """Gather one error per window (say, `squared_errors_cm2(...)[:, :k].mean(1)`) by clip."""
    clips, place, windows = np.unique(clip, return_inverse=True, return_counts=True)
    total = np.bincount(place, weights=errors.astype(np.float64), minlength=len(clips))
    return ClipErrors(clips=clips, mean=total / windows, windows=windows)


def bootstrap_ratio(
    candidate: Float[np.ndarray, " window"],
    reference: Float[np.ndarray, " window"],
    clip: Int[np.ndarray, " window"],
    *,
    draws: int = 2000,
    confidence: float = 0.95,
    seed: int = 0,
) -> Ratio:
    """Compare two forecasters on the same windows: mean error of candidate ÷ of reference.

    Windows of a clip overlap and so are not independent: whole clips are resampled, and both
    forecasters are scored on the same draw (a paired percentile bootstrap; Efron and Tibshirani,
    An Introduction to the Bootstrap, 1993).

    Args:
        candidate: one error per window.
        reference: the other forecaster's error on the same windows.
        clip: the clip of each window.
        draws: number of resamples.
        confidence: coverage of the interval.
        seed: the same seed gives the same interval.

    Raises:
        ValueError: if there is no window, `confidence` is not between 0 and 1, or the reference
            has no error at all.
    """
    if not len(clip):
        raise ValueError("there are no windows to compare")
    above, below = errors_per_clip(candidate, clip), errors_per_clip(reference, clip)
    (ratio,) = ratio_intervals(
        (above.mean * above.windows)[:, None],
        (below.mean * below.windows)[:, None],
        draws=draws,
        confidence=confidence,
        seed=seed,
    )
    return ratio


def ratio_intervals(
    candidate: Float64[np.ndarray, "clip cell"],
    reference: Float64[np.ndarray, "clip cell"],
    *,
    draws: int = 2000,
    confidence: float = 0.95,
    seed: int = 0,
) -> list[Ratio]:
    """Compare sums of errors per clip, in several cells by the same draws of clips.

    Args:
        candidate: sum of the errors of each clip's windows, in each cell (say, a frame).
        reference: the same of the other forecaster.
        draws: number of resamples.
        confidence: coverage of the interval.
        seed: the same seed gives the same intervals.

    Raises:
        ValueError: if there is no clip, `confidence` is not between 0 and 1, or the reference has
            no error at all in a clip.
    """
    count = len(reference)
    if not count:
        raise ValueError("there are no clips to compare")
    if not 0 < confidence < 1 or draws < 1:
        raise ValueError("confidence must lie between 0 and 1, and draws be positive")
    if reference.min() <= 0:
        raise ValueError("the reference has a clip without any error, so no ratio can be taken")
    picks = np.random.default_rng(seed).integers(count, size=(draws, count))
    rows = np.arange(draws)[:, None] * count
    often = np.bincount((rows + picks).ravel(), minlength=draws * count)
    weights = often.reshape(draws, count).astype(np.float64)
    drawn = (weights @ candidate) / (weights @ reference)
    bounds = [(1 - confidence) / 2, (1 + confidence) / 2]
    low, high = np.quantile(drawn, bounds, axis=0)
    value = candidate.sum(axis=0) / reference.sum(axis=0)
    return [Ratio(*map(float, cell)) for cell in zip(value, low, high, strict=True)]
