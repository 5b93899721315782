"""Figures from recordings: people as they moved and were forecast."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.figures.rows import MissingError
from benchmarks.figures.style import COLOURS, INK, NAMES, SOFT
from benchmarks.planning.people import find_version
from benchmarks.studies.recordings import UTD, Place, read_person
from models.baselines import Forecaster, ZeroVelocity
from models.checkpoint import SHIPPED, load_checkpoint, load_personal
from models.data.clips import Clip
from models.data.splits import PERSONAL_TRIAL, TEST_SUBJECTS, TEST_TRIALS
from models.data.windows import cut_windows
from models.metrics import squared_errors_cm2
from models.predictor import Predictor
from models.skeleton import KINECT_V1
from models.spec import MotionSpec

_SPEC = MotionSpec()
_OBSERVED, _SHOWN = (0, 7, 14), (2, 5, 8, 11, 14)
_STEP_M = 0.75
"""Between two poses that are drawn beside each other."""


def draw_poses() -> Figure:
    """Draw what was observed, what followed, and what was expected, as stick figures over time.

    Shown is, for each test subject, the clip whose gain is the median of all, and in it the window
    with the most movement: neither the best nor the worst.
    """
    figure, axes = plt.subplots(3, 1, figsize=(10, 8.4), layout="constrained")
    for axis, subject in zip(axes, TEST_SUBJECTS, strict=True):
        clips = read_clips(subject, *TEST_TRIALS)
        methods = _make_methods(read_clips(subject, PERSONAL_TRIAL))
        windows = cut_windows(clips, _SPEC)
        made = {name: _run(one, windows.observed) for name, one in methods.items()}
        errors = {
            name: squared_errors_cm2(one, windows.future)[:, -1] for name, one in made.items()
        }
        clip = _find_median(errors, windows.clip)
        rows = np.flatnonzero(windows.clip == clip)
        row = int(rows[errors["zero_velocity"][rows].argmax()])
        _draw_row(
            axis, windows.observed[row], windows.future[row], {n: m[row] for n, m in made.items()}
        )
        told = ", ".join(
            f"{NAMES[name].split(',')[0]} {errors[name][row] ** 0.5:.0f}" for name in made
        )
        axis.set_title(
            f"subject {subject}, action {clips[clip].action}; at 500 ms, cm: {told}", loc="left"
        )
    figure.suptitle(
        "Observed, then forecast over what happened (clip of median gain, window of most movement)"
    )
    return figure


def read_clips(subject: str, *trials: str) -> list[Clip]:
    """Read the clips of a subject of UTD-MHAD, of some trials or of all.

    Raises:
        MissingError: the recordings are not where they were looked for.
    """
    place = Place.default()
    if not place.utd.exists():
        raise MissingError("UTD_MHAD=FOLDER make figures")
    return read_person(place, f"{UTD}/{subject}", *trials)


def _make_methods(trial: Sequence[Clip]) -> dict[str, Forecaster]:
    base = load_checkpoint(SHIPPED)
    blob = find_version(trial, say=print)
    served = (
        load_personal(blob, base.predictor, base_sha256=base.sha256) if blob else base.predictor
    )
    return {"zero_velocity": ZeroVelocity(), "base": base.predictor, "served": served}


def _run(forecaster: Forecaster, observed: np.ndarray) -> np.ndarray:
    with torch.inference_mode():
        if isinstance(forecaster, Predictor):
            forecaster.eval()
        parts = torch.from_numpy(observed).split(512)
        return torch.cat([forecaster(part) for part in parts]).numpy()


def _find_median(errors: Mapping[str, np.ndarray], clip: np.ndarray) -> int:
    """Give the clip whose ratio of personal to base is the median."""
    clips = np.unique(clip)
    ratios = [
        errors["served"][clip == one].mean() / errors["base"][clip == one].mean() for one in clips
    ]
    return int(clips[np.argsort(ratios)[len(ratios) // 2]])


def _draw_row(
    axis: Axes, observed: np.ndarray, future: np.ndarray, made: Mapping[str, np.ndarray]
) -> None:
    """Draw poses from left to right: three observed, then forecasts over the truth."""
    middle = observed[-1, 0, 0]
    for place, frame in enumerate(_OBSERVED):
        _draw_pose(axis, observed[frame], place * _STEP_M - middle, colour=INK, width=1.4)
        _write_time(axis, place, (frame - _SPEC.observe + 1) / _SPEC.rate_hz, observed)
    for place, frame in enumerate(_SHOWN, start=len(_OBSERVED)):
        shift = place * _STEP_M - middle
        for name, frames in made.items():
            _draw_pose(axis, frames[frame], shift, colour=COLOURS[name], width=1.1)
        _draw_pose(axis, future[frame], shift, colour=COLOURS["truth"], width=1.6)
        _write_time(axis, place, (frame + 1) / _SPEC.rate_hz, observed)
    for name in ("truth", *made):
        axis.plot([], [], color=COLOURS[name], label=NAMES[name])
    axis.set_aspect("equal")
    axis.axis("off")
    axis.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=8)


def _draw_pose(axis: Axes, pose: np.ndarray, shift: float, *, colour: str, width: float) -> None:
    for joint, parent in enumerate(KINECT_V1.parents):
        if parent >= 0:
            ends = pose[[parent, joint]]
            axis.plot(
                ends[:, 0] + shift, ends[:, 1], color=colour, lw=width, solid_capstyle="round"
            )


def _write_time(axis: Axes, place: int, seconds: float, observed: np.ndarray) -> None:
    foot = float(observed[..., 1].min())
    axis.text(
        place * _STEP_M,
        foot - 0.12,
        f"{1000 * seconds:+.0f} ms",
        ha="center",
        color=SOFT,
        fontsize=8,
    )
