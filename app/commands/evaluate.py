"""`kinecast evaluate`: the table of errors, of a base and of what it becomes for a person."""

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer
from rich import box
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from app.commands.files import read_clips, refuse_place
from app.commands.output import err, fail, out
from app.personalize.offline import choose_forecaster, describe, personalize
from models.baselines import Forecaster
from models.checkpoint import SHIPPED, Checkpoint, CheckpointError, load_checkpoint
from models.data.clips import Clip
from models.data.splits import TEST_TRIALS, select
from models.data.windows import cut_windows
from models.metrics import FRAMES
from models.training import evaluate as evaluation
from models.training.calibrate import measure_coverage


def evaluate_command(
    data: Annotated[
        Path, typer.Option(help="Folder or zip of UTD-MHAD, or an .npz of the documented keys.")
    ],
    subjects: Annotated[str | None, typer.Option(help="Subjects, such as 2,4,6.")] = None,
    personalize_trials: Annotated[
        str | None,
        typer.Option(help="Trials to fine-tune each subject on, such as 1; needs --subjects."),
    ] = None,
    finetune_steps: Annotated[
        int | None, typer.Option(min=1, help="Steps of a fit; those of the recipe unless told.")
    ] = None,
    test_trials: Annotated[
        str | None, typer.Option(help="Trials to test on; 2,3,4 of UTD-MHAD, all of an .npz.")
    ] = None,
    model: Annotated[Path, typer.Option(help="The checkpoint to score.")] = SHIPPED,
    json_out: Annotated[
        Path | None, typer.Option("--json", help="Write the figures here; - prints them.")
    ] = None,
    *,
    baselines: Annotated[
        bool, typer.Option("--baselines", help="Score damped velocity and ridge as well.")
    ] = False,
) -> None:
    """Print the error table of a model: cm² and mm, by subject and frame, against baselines."""
    if personalize_trials and not subjects:
        fail("--personalize-trials needs --subjects: every person is fine-tuned alone", status=2)
    if json_out is not None and str(json_out) != "-":
        refuse_place("--json", json_out)
        if not json_out.parent.is_dir():
            fail(f"--json: there is no folder {json_out.parent}", status=2)
    try:
        checkpoint = load_checkpoint(model)
    except (OSError, CheckpointError) as error:
        fail(f"{model}: {error}", status=2)
    everybody = read_clips(data, None)
    trials = test_trials.split(",") if test_trials else _default_trials(data)
    own = personalize_trials.split(",") if personalize_trials else []
    if set(own) & set(trials or own):
        fail("a trial that is trained on cannot be tested on: set --test-trials", status=2)
    test = select(everybody, subjects=subjects.split(",") if subjects else None, trials=trials)
    if not test:
        wanted = f"subjects {subjects or 'any'} and trials {','.join(trials or ['any'])}"
        fail(f"no clips of {wanted} in {data}", status=2)
    rows = _score(checkpoint, everybody, test, by_subject=bool(subjects), more=baselines)
    if own:
        personal = _score_personal(model, everybody, test, own, steps=finetune_steps)
        rows = _order([*rows, *personal])
    description = {"file": model.name, "sha256": checkpoint.sha256}
    protocol = evaluation.describe_protocol(test, model=description)
    report = {"protocol": protocol, "rows": [row.as_json() for row in rows]}
    if json_out is not None:
        _write_json(json_out, report)
    if json_out is None or str(json_out) != "-":
        _show(rows, published=_is_paper_protocol(data, trials))


def _score(
    checkpoint: Checkpoint,
    everybody: Sequence[Clip],
    test: Sequence[Clip],
    *,
    by_subject: bool,
    more: bool,
) -> list[evaluation.Row]:
    methods: dict[str, Forecaster] = {"base": checkpoint.predictor}
    methods |= evaluation.simple_baselines() if more else {}
    rows = evaluation.evaluate(methods, test, by_subject=by_subject)
    rows = [_with_coverage(row, checkpoint, test) if row.method == "base" else row for row in rows]
    training = [clip for clip in evaluation.training_clips(everybody) if clip.source == "utd-mhad"]
    if more and by_subject and training:
        rows += evaluation.evaluate_ridge(training, everybody, test)
    elif more:
        err.print("ridge needs UTD-MHAD's subjects 1, 3, 5, 7 to be fitted on: left out")
    return _order(rows)


def _order(rows: Sequence[evaluation.Row]) -> list[evaluation.Row]:
    return sorted(rows, key=lambda row: (len(row.subject), row.subject))


def _score_personal(
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


def _default_trials(data: Path) -> Sequence[str] | None:
    return None if data.suffix == ".npz" else TEST_TRIALS


def _is_paper_protocol(data: Path, trials: Sequence[str] | None) -> bool:
    return data.suffix != ".npz" and trials is not None and tuple(trials) == TEST_TRIALS


def _write_json(path: Path, report: Mapping[str, object]) -> None:
    text = json.dumps(report, indent=1)
    if str(path) == "-":
        sys.stdout.write(text + "\n")
    else:
        path.write_text(text + "\n")


def _show(rows: Sequence[evaluation.Row], *, published: bool) -> None:
    """Print three tables that fit 80 columns: the protocol's, the errors at a frame, the mm."""
    out.print(
        _table("mse_cm2", "cm², mean over frames 1..k (the protocol)", rows, published=published)
    )
    out.print(_table("mse_cm2_at", "cm², at frame k", rows))
    out.print(_table("mpjpe_mm", "mean distance per joint in mm, at frame k", rows))
    for row in rows:
        if row.coverage is not None:
            told = ", ".join(f"{p:.0%}: {q:.1%}" for p, q in row.coverage.items())
            out.print(f"coverage of the radius, {row.method}, subject {row.subject}: {told}")


def _table(
    measure: str,
    title: str,
    rows: Sequence[evaluation.Row],
    *,
    published: bool = False,
) -> Table:
    table = Table(title=title, title_justify="left", box=box.SIMPLE, pad_edge=False)
    table.add_column("subject, method", no_wrap=True)
    for frame in FRAMES:
        table.add_column(f"{frame}\n{frame * 1000 / 30:.0f} ms", justify="right", no_wrap=True)
    for subject in dict.fromkeys(row.subject for row in rows):
        for row in rows:
            if row.subject == subject:
                cells = [f"{value:.2f}" for value in getattr(row.scores, measure)]
                table.add_row(f"{subject}  {row.method}", *cells)
        for (name, whose), values in evaluation.PUBLISHED.items():
            if published and whose == subject:
                table.add_row(f"{subject}  {name}", *(f"{v:.2f}" for v in values), style="dim")
        table.add_section()
    return table
