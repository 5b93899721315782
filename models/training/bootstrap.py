"""Compare two methods on the same windows, with an interval: a paired bootstrap over clips.

Windows of a clip overlap, so that thousands of them are only some eighty independent recordings.
Whole clips are resampled, and both methods are scored on the same draw.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64, Int64

from models.baselines import Forecaster
from models.data.windows import Windows
from models.metrics import FRAMES, Ratio, ratio_intervals, squared_errors_cm2

_BATCH = 512


@dataclass(frozen=True, eq=False)
class ClipSums:
    """What a method got wrong in each clip; enough for the error of any choice of clips.

    Attributes:
        sums: over the windows of a clip, of the error in cm² of the protocol: the mean squared
            error per coordinate over the frames 1..k.
        windows: how many windows the clip has.
        frames: the frames k, counted from 1.
    """

    sums: Float64[np.ndarray, "clip frame"]
    windows: Int64[np.ndarray, " clip"]
    frames: tuple[int, ...] = FRAMES

    @property
    def mse_cm2(self) -> tuple[float, ...]:
        """Give the error at each frame, over all windows: what `evaluate_forecasts` gives."""
        return tuple(float(value) for value in self.sums.sum(axis=0) / self.windows.sum())


@torch.inference_mode()
def clip_errors(
    forecaster: Forecaster, windows: Windows, *, frames: tuple[int, ...] = FRAMES
) -> ClipSums:
    """Sum up a forecaster's errors by clip, in the order of the clips.

    Clips without a window have no line.

    Raises:
        ValueError: there is no window.
    """
    if not len(windows):
        raise ValueError("there are no windows to score")
    parts = torch.as_tensor(windows.observed).split(_BATCH)
    forecast = torch.cat([forecaster(part) for part in parts]).numpy()
    errors = squared_errors_cm2(forecast, windows.future)
    cumulative = errors.cumsum(axis=1) / np.arange(1, errors.shape[1] + 1)
    _, place, counts = np.unique(windows.clip, return_inverse=True, return_counts=True)
    sums = np.zeros((len(counts), len(frames)))
    np.add.at(sums, place, cumulative[:, [k - 1 for k in frames]])
    return ClipSums(sums, counts.astype(np.int64), frames)


def join_clips(parts: Sequence[ClipSums]) -> ClipSums:
    """Put the clips of several people one after the other.

    Raises:
        ValueError: nothing to join, or errors at different frames.
    """
    if len({part.frames for part in parts}) != 1:
        raise ValueError("only errors at the same frames can be joined")
    return ClipSums(
        np.concatenate([part.sums for part in parts]),
        np.concatenate([part.windows for part in parts]),
        parts[0].frames,
    )


def bootstrap_ratios(
    candidate: ClipSums,
    reference: ClipSums,
    *,
    draws: int = 2000,
    confidence: float = 0.95,
    seed: int = 0,
) -> dict[int, Ratio]:
    """Divide the candidate's error by the reference's at each frame, with intervals.

    The same draws of clips serve all frames. A percentile bootstrap (Efron and Tibshirani, An
    Introduction to the Bootstrap, 1993).

    Args:
        candidate: one method's errors.
        reference: the other's, on the same windows.
        draws: number of resamples.
        confidence: coverage of the interval.
        seed: the same seed gives the same intervals.

    Raises:
        ValueError: the two were not measured on the same windows and frames, or see
            `ratio_intervals`.
    """
    same = np.array_equal(candidate.windows, reference.windows)
    if not same or candidate.frames != reference.frames:
        raise ValueError("two methods are compared on the same windows and frames")
    ratios = ratio_intervals(
        candidate.sums, reference.sums, draws=draws, confidence=confidence, seed=seed
    )
    return dict(zip(candidate.frames, ratios, strict=True))
