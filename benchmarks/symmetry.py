"""How nearly do mirrored people get mirrored forecasts?

    python -m benchmarks.symmetry --data ../shared/data/utd-mhad

A base is symmetric by construction if it was trained to be (`PretrainConfig.symmetric`). Prints, as
JSON and in mm by frame, how far the forecast of a mirrored window is from the mirrored forecast,
beside how far the forecast is from the truth and how far people moved.
"""

import argparse
import json
from pathlib import Path

import torch

from models.checkpoint import SHIPPED, load_checkpoint
from models.data.augment import mirror
from models.data.clips import load_clips
from models.data.splits import TEST_SUBJECTS, TEST_TRIALS
from models.data.windows import cut_windows
from models.metrics import FRAMES
from models.predictor import forecast_in_batches


def mean_distance_mm(one: torch.Tensor, other: torch.Tensor) -> list[float]:
    distance = (one - other).norm(dim=-1).mean(dim=(0, 2)) * 1000
    return [round(float(distance[frame - 1]), 2) for frame in FRAMES]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--model", type=Path, default=SHIPPED)
    arguments = parser.parse_args()
    predictor = load_checkpoint(arguments.model).predictor
    clips = load_clips(arguments.data, subjects=TEST_SUBJECTS, trials=TEST_TRIALS)
    windows = cut_windows(clips, predictor.spec, stride=3)
    observed, future = torch.as_tensor(windows.observed), torch.as_tensor(windows.future)
    forecast = forecast_in_batches(predictor, observed)
    again = mirror(forecast_in_batches(predictor, mirror(observed)))
    report = {
        "windows": len(windows),
        "frames": FRAMES,
        "asymmetry_mm": mean_distance_mm(forecast, again),
        "error_mm": mean_distance_mm(forecast, future),
        "motion_mm": mean_distance_mm(observed[:, -1:], future),
    }
    print(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
