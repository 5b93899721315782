"""The table of the pinned protocol: every method on every subject, in one run."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch

from models.baselines import DampedVelocity, Forecaster, Ridge, ZeroVelocity
from models.data.clips import Clip, data_hash
from models.data.splits import PERSONAL_TRIAL, TRAIN_SUBJECTS, select
from models.data.windows import Windows, cut_windows
from models.metrics import FRAMES, Scores, evaluate_forecasts
from models.spec import MotionSpec

EVERYBODY = "all"
_BATCH = 512
_SPEC = MotionSpec()

PUBLISHED: dict[tuple[str, str], tuple[float, ...]] = {
    ("paper: zero velocity", "2"): (11.20, 27.37, 66.85, 86.23, 112.39, 127.64),
    ("paper: zero velocity", "4"): (13.11, 32.33, 77.22, 97.80, 123.99, 138.53),
    ("paper: zero velocity", "6"): (10.37, 25.56, 64.62, 85.29, 115.33, 135.17),
    ("paper: base", "2"): (5.41, 14.75, 33.87, 41.89, 51.33, 56.12),
    ("paper: base", "4"): (7.78, 18.26, 41.66, 51.46, 62.67, 68.10),
    ("paper: base", "6"): (6.99, 16.18, 38.51, 49.40, 63.70, 71.68),
    ("paper: personal", "2"): (7.62, 16.17, 32.35, 38.63, 45.72, 49.13),
    ("paper: personal", "4"): (6.98, 14.79, 30.29, 36.51, 43.81, 47.61),
    ("paper: personal", "6"): (6.51, 13.44, 27.49, 33.66, 41.74, 46.41),
}
"""The rows of the paper's table (cm², cumulative), to be read beside ours."""


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the table: a method on a subject.

    Attributes:
        method, subject: of what and on whom.
        windows, clips: how many were tested.
        scores: the errors.
        coverage: of the radius, by level.
        version: what the judge said of a personal version.
    """

    method: str
    subject: str
    windows: int
    clips: int
    scores: Scores
    coverage: dict[float, float] | None = None
    version: Mapping[str, Any] | None = None

    def as_json(self) -> dict[str, Any]:
        """Give the row as the command line writes it."""
        found = {
            "method": self.method,
            "subject": self.subject,
            "windows": self.windows,
            "clips": self.clips,
            **asdict(self.scores),
        }
        if self.coverage is not None:
            found["coverage"] = {str(level): share for level, share in self.coverage.items()}
        if self.version is not None:
            found["version"] = dict(self.version)
        return found


def evaluate(
    forecasters: dict[str, Forecaster], clips: Sequence[Clip], *, by_subject: bool
) -> list[Row]:
    """Score every forecaster on the same windows, zero velocity always among them.

    Args:
        forecasters: by the method's name; each sees the windows alone.
        clips: the test clips, cut at stride 1.
        by_subject: one row per subject, or one over everybody.

    Raises:
        ValueError: no clip is as long as a window.
    """
    methods = {"zero_velocity": ZeroVelocity(_SPEC.horizon), **forecasters}
    groups = group_by_subject(clips) if by_subject else {EVERYBODY: list(clips)}
    rows = []
    for subject, own in groups.items():
        windows = cut_windows(own, _SPEC)
        for name, forecaster in methods.items():
            scores = score_forecaster(forecaster, windows)
            rows.append(Row(name, subject, len(windows), len(own), scores))
    return rows


def evaluate_ridge(
    training: Sequence[Clip],
    everybody: Sequence[Clip],
    test: Sequence[Clip],
    *,
    trials: Sequence[str] = (PERSONAL_TRIAL,),
) -> list[Row]:
    """Rows of the ridge, and of its closed-form personal twin where a subject has the trial for it.

    Args:
        training: clips that the ridge is fitted on; its strengths are chosen by leaving their
            people out.
        everybody: clips in which the personal trials are looked for.
        test: the test clips.
        trials: what the personal twin is fitted on.
    """
    ridge = Ridge.fit(cut_windows(training, _SPEC), clips=training)
    return evaluate_adaptable(
        "ridge",
        ridge,
        lambda clips: ridge.personalize(cut_windows(clips, _SPEC)),
        everybody,
        test,
        trials=trials,
    )


def evaluate_adaptable(
    name: str,
    forecaster: Forecaster,
    personalize: Callable[[list[Clip]], Forecaster],
    everybody: Sequence[Clip],
    test: Sequence[Clip],
    *,
    trials: Sequence[str] = (PERSONAL_TRIAL,),
) -> list[Row]:
    """Rows of a method, and of what it becomes for each subject who has the trials for it.

    Args:
        name: of the method; what it becomes is `<name>_personal`.
        forecaster: the method before it knows anybody.
        personalize: what it becomes by a person's clips.
        everybody: clips in which the personal trials are looked for.
        test: the test clips; who is tested on a personal trial gets no personal row.
        trials: the personal trials.
    """
    rows = []
    for subject, own in group_by_subject(test).items():
        methods = {name: forecaster}
        trial = select(everybody, subjects=[subject], trials=trials)
        if trial and all(clip.trial not in trials for clip in own):
            methods[f"{name}_personal"] = personalize(trial)
        rows += [row for row in evaluate(methods, own, by_subject=True) if row.method in methods]
    return rows


def training_clips(clips: Iterable[Clip]) -> list[Clip]:
    """Keep the clips of the subjects on which bases and baselines are fitted."""
    return select(clips, subjects=TRAIN_SUBJECTS)


def simple_baselines() -> dict[str, Forecaster]:
    """Baselines that need no fitting."""
    return {"damped_velocity": DampedVelocity(_SPEC.horizon)}


@torch.inference_mode()
def score_forecaster(forecaster: Forecaster, windows: Windows) -> Scores:
    """Score one forecaster by the pinned protocol."""
    observed = torch.as_tensor(windows.observed)
    forecast = torch.cat([forecaster(part) for part in observed.split(_BATCH)])
    return evaluate_forecasts(forecast.numpy(), windows.future)


def describe_protocol(clips: Sequence[Clip], *, model: dict[str, Any] | None) -> dict[str, Any]:
    """Say what the figures mean and what they were measured on."""
    return {
        "observe": _SPEC.observe,
        "horizon": _SPEC.horizon,
        "rate_hz": _SPEC.rate_hz,
        "stride": 1,
        "frames": list(FRAMES),
        "mse_cm2": "mean over windows, joints, coordinates and frames 1..k of the squared error",
        "mse_cm2_at": "the same at frame k alone",
        "mpjpe_mm": "mean distance per joint at frame k",
        "coordinates": "absolute, no alignment, all joints",
        "trials": sorted({clip.trial for clip in clips}),
        "data_sha256": data_hash(clips),
        "model": model,
    }


def group_by_subject(clips: Sequence[Clip]) -> dict[str, list[Clip]]:
    """Clips of each subject, in the order in which subjects first appear."""
    groups: dict[str, list[Clip]] = {}
    for clip in clips:
        groups.setdefault(clip.subject, []).append(clip)
    return groups
