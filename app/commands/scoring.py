"""Rows of `kinecast evaluate`: base, baselines, and what becomes of them for a person."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from app.commands.output import err, fail
from app.personalize.offline import choose_forecaster, describe, personalize
from models.baselines import Forecaster
from models.checkpoint import Checkpoint
from models.data.clips import Clip
from models.data.splits import PERSONAL_TRIAL, select
from models.data.utd_mhad import SOURCE
from models.data.windows import cut_windows
from models.training import evaluate as evaluation
from models.training.calibrate import measure_coverage
from models.training.simlpe import SimlpeFinetune, personalize_simlpe
from models.training.simlpe_file import SimlpeFile


def score_base(
    checkpoint: Checkpoint, test: Sequence[Clip], *, by_subject: bool
) -> list[evaluation.Row]:
    """Rows of zero velocity and of the base, with the coverage of its radius."""
    methods: dict[str, Forecaster] = {"base": checkpoint.predictor}
    rows = evaluation.evaluate(methods, test, by_subject=by_subject)
    return [_with_coverage(row, checkpoint, test) if row.method == "base" else row for row in rows]


def score_baselines(
    everybody: Sequence[Clip],
    test: Sequence[Clip],
    own: Sequence[str],
    peer: SimlpeFile | None,
    *,
    by_subject: bool,
    steps: int | None = None,
) -> list[evaluation.Row]:
    """Rows of everything that ours is compared with; personal ones by the same trials as ours.

    `steps` are those of the peer's fit; None for those of its recipe.
    """
    methods = evaluation.simple_baselines()
    trials = own or [PERSONAL_TRIAL]
    training = [clip for clip in evaluation.training_clips(everybody) if clip.source == SOURCE]
    rows = []
    if by_subject and training:
        rows += evaluation.evaluate_ridge(training, everybody, test, trials=trials)
    else:
        err.print("ridge needs UTD-MHAD's subjects 1, 3, 5, 7 to be fitted on: left out")
    if peer is None:
        err.print(
            "simlpe: left out; train it with `kinecast pretrain-peer` and name it with --simlpe"
        )
    elif by_subject:
        recipe = SimlpeFinetune() if steps is None else replace(SimlpeFinetune(), steps=steps)
        rows += evaluation.evaluate_adaptable(
            "simlpe",
            peer.net,
            lambda clips: personalize_simlpe(peer.net, clips, recipe),
            everybody,
            test,
            trials=trials,
        )
    else:
        methods["simlpe"] = peer.net
    found = evaluation.evaluate(methods, test, by_subject=by_subject)
    return [row for row in found if row.method in methods] + rows


def order(rows: Sequence[evaluation.Row]) -> list[evaluation.Row]:
    """Put the rows of each subject together."""
    return sorted(rows, key=lambda row: (len(row.subject), row.subject))


def score_personal(
    model: Path,
    everybody: Sequence[Clip],
    test: Sequence[Clip],
    trials: Sequence[str],
    *,
    steps: int | None,
) -> list[evaluation.Row]:
    """Fine-tune and judge for every subject, and score what the service would answer with."""
    rows, base = [], model.read_bytes()
    for subject, own in evaluation.group_by_subject(test).items():
        clips = select(everybody, subjects=[subject], trials=trials)
        if not clips:
            fail(f"no clips of subject {subject} and trials {','.join(trials)}", status=2)
        with _Bar(f"subject {subject}") as report:
            outcome = personalize(base, clips, report, steps=steps)
        err.print(f"subject {subject}: {outcome.verdict}. {outcome.message}", markup=False)
        methods = {"personal": choose_forecaster(base, outcome)}
        scored = evaluation.evaluate(methods, own, by_subject=True)
        rows += [
            replace(row, version=describe(outcome)) for row in scored if row.method == "personal"
        ]
    return rows


class _Bar:
    """Shows how far a fine-tuning run is."""

    def __init__(self, name: str) -> None:
        self._bar = Progress(
            TextColumn("{task.description} {task.fields[phase]}"),
            BarColumn(),
            TextColumn("{task.completed}/{task.total}"),
            TimeRemainingColumn(),
            console=err,
            refresh_per_second=2,
            disable=not err.is_terminal,
        )
        self._task = self._bar.add_task(name, total=None, phase="")

    def __enter__(self) -> "_Bar":
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def __call__(self, values: Mapping[str, Any]) -> None:
        phase, step, steps = values["phase"], values.get("step", 0), values.get("steps")
        self._bar.update(self._task, phase=phase, completed=step, total=steps)


def _with_coverage(
    row: evaluation.Row, checkpoint: Checkpoint, test: Sequence[Clip]
) -> evaluation.Row:
    if checkpoint.radius is None:
        return row
    own = test if row.subject == evaluation.EVERYBODY else select(test, subjects=[row.subject])
    windows = cut_windows(own, checkpoint.predictor.spec)
    found = measure_coverage(checkpoint.predictor, checkpoint.radius, windows)
    return replace(row, coverage=found)
