"""The people that the robot meets: recordings, with what each forecaster expects at every frame."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32

from benchmarks.studies.cache import make_key
from benchmarks.studies.personal import make_served
from benchmarks.studies.study import describe_fit
from models.baselines import Forecaster, ZeroVelocity
from models.checkpoint import SHIPPED, load_checkpoint, load_personal, write_atomically
from models.data.clips import Clip, data_hash
from models.data.splits import PERSONAL_TRIAL, TEST_TRIALS, select
from models.predictor import forecast_in_batches
from models.spec import MotionSpec

SPEC = MotionSpec()
VERSIONS = Path("build/planning")
METHODS = ("zero velocity", "base", "personal", "truth")
"""What the robot believes about the next half second; the last one is an oracle."""
Say = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class Scene:
    """One clip, and what every method forecasts from its frame `SPEC.observe - 1` on.

    Attributes:
        clip: whose, and what.
        truth: what happens from that frame on; metres, y up.
        forecasts: by method, for each frame but the last one, what comes after it.
    """

    clip: Clip
    truth: Float32[np.ndarray, "time joint 3"]
    forecasts: Mapping[str, Float32[np.ndarray, "step horizon joint 3"]]

    @property
    def name(self) -> str:
        """Name the clip within UTD-MHAD."""
        return f"a{self.clip.action}_s{self.clip.subject}_t{self.clip.trial}"


def read_scenes(clips: Sequence[Clip], forecasters: Mapping[str, Forecaster]) -> list[Scene]:
    """Forecast every frame of every clip by every forecaster, and add the oracle."""
    return [_read_scene(clip, forecasters) for clip in clips if len(clip.poses) > SPEC.observe]


def _read_scene(clip: Clip, forecasters: Mapping[str, Forecaster]) -> Scene:
    truth = clip.poses[SPEC.observe - 1 :]
    windows = torch.as_tensor(_slide(clip.poses, SPEC.observe)[:-1].copy())
    expected = {name: _run(forecaster, windows) for name, forecaster in forecasters.items()}
    held = np.concatenate([truth, np.repeat(truth[-1:], SPEC.horizon - 1, axis=0)])
    expected["truth"] = _slide(held[1:], SPEC.horizon)
    return Scene(clip, truth, expected)


def _slide(poses: np.ndarray, length: int) -> np.ndarray:
    """Give every stretch of `length` frames: [start, length, joint, 3]."""
    view = np.lib.stride_tricks.sliding_window_view(poses, length, axis=0)
    return np.moveaxis(view, -1, 1)


def _run(forecaster: Forecaster, windows: torch.Tensor) -> np.ndarray:
    if isinstance(forecaster, torch.nn.Module):
        return forecast_in_batches(forecaster, windows).numpy()
    with torch.inference_mode():
        return forecaster(windows).numpy()


def read_subject(clips: Sequence[Clip], subject: str, *, personal: bool, say: Say) -> list[Scene]:
    """Give a subject's test clips, with forecasts of the shipped base and, if wanted, of a version.

    The version is what the service would answer with after the subject's trial 1, with judge and
    gate; it is fitted once and kept in `build/planning`.
    """
    base = load_checkpoint(SHIPPED)
    forecasters: dict[str, Forecaster] = {"zero velocity": ZeroVelocity(), "base": base.predictor}
    if personal:
        trial = select(clips, subjects=[subject], trials=[PERSONAL_TRIAL])
        blob = find_version(trial, say=say)
        forecasters["personal"] = (
            load_personal(blob, base.predictor, base_sha256=base.sha256) if blob else base.predictor
        )
    return read_scenes(select(clips, subjects=[subject], trials=TEST_TRIALS), forecasters)


def find_version(trial: Sequence[Clip], *, say: Say, folder: Path = VERSIONS) -> bytes:
    """Give the personal weights after a trial; empty where they were not promoted."""
    base = SHIPPED.read_bytes()
    decided_by: dict[str, Any] = {
        "base": load_checkpoint(base).sha256,
        "data": data_hash(trial),
        "fit": describe_fit(),
    }
    path = folder / f"{make_key(decided_by)}.safetensors"
    if not path.exists():
        say(f"fitting subject {trial[0].subject} to {len(trial)} clips, about a minute")
        served = make_served(base, trial)
        say(f"{served.outcome.verdict} after {served.seconds:.0f} s")
        promoted = served.forecaster is not None and str(served.outcome.verdict) == "promote"
        folder.mkdir(parents=True, exist_ok=True)
        write_atomically(path, (served.outcome.blob or b"") if promoted else b"")
    return path.read_bytes()
