"""Measure the radius: how far forecasts were off on people whom a net had never seen.

Bases are trained with some people left out, each is asked to forecast just these people, and the
errors of all of them together give the table that goes into the base that was trained on everybody.
That base has seen a little more than they had, so the radius errs on the wide side.
"""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32

from models.checkpoint import Checkpoint
from models.data.clips import Clip
from models.data.windows import Windows, cut_windows
from models.metrics import evaluate_forecasts
from models.predictor import Predictor, forecast_in_batches
from models.uncertainty import LEVELS, RadiusTable, coverage_of


def calibrate(folds: Sequence[Checkpoint], clips: Sequence[Clip]) -> tuple[RadiusTable, Any]:
    """Pool the errors of each fold on the people it left out.

    Args:
        folds: nets whose metadata names the people left out.
        clips: recordings of (at least) these people.

    Returns:
        The table, and the scores of each fold for the metadata.

    Raises:
        ValueError: a fold left nobody out, or its people are not among the clips.
    """
    distances, scores = [], {}
    for fold in folds:
        left_out = set(fold.metadata["left_out"])
        own = [clip for clip in clips if "/".join(clip.person) in left_out]
        if not own:
            raise ValueError(f"no recordings of the people whom a net left out: {sorted(left_out)}")
        people = sorted({"/".join(clip.person) for clip in own})
        windows = cut_windows(own, fold.predictor.spec)
        distances.append(forecast_distances(fold.predictor, windows))
        forecast = forecast_in_batches(fold.predictor, torch.as_tensor(windows.observed))
        scores[", ".join(people)] = asdict(evaluate_forecasts(forecast.numpy(), windows.future))
    pooled = np.concatenate(distances)
    return RadiusTable.calibrate(pooled, calibrated_on="; ".join(scores)), scores


def forecast_distances(
    predictor: Predictor, windows: Windows
) -> Float32[np.ndarray, "window horizon joint"]:
    """Distance in metres between each forecast joint and the true one."""
    forecast = forecast_in_batches(predictor, torch.as_tensor(windows.observed)).numpy()
    distance = np.linalg.norm(forecast - windows.future, axis=-1)
    return np.asarray(distance, dtype=np.float32)


def measure_coverage(
    predictor: Predictor,
    radius: RadiusTable,
    windows: Windows,
    *,
    levels: Sequence[float] = (0.5, 0.8, 0.9, 0.95),
) -> dict[float, float]:
    """Share of joints within the radius, for each promised coverage."""
    unknown = [level for level in levels if level not in LEVELS]
    if unknown:
        raise ValueError(f"coverage was not calibrated at {unknown}")
    distances = forecast_distances(predictor, windows)
    return {level: coverage_of(distances, radius.radius(level)) for level in levels}
