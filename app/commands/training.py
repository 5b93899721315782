"""`kinecast pretrain`, `kinecast calibrate` and `kinecast evaluate`: what a researcher runs."""

import json
import os
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer
from rich import box
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from app.commands.output import err, fail, out
from models.baselines import Forecaster
from models.checkpoint import SHIPPED, Checkpoint, CheckpointError, load_checkpoint, save_checkpoint
from models.data.clips import Clip, load_clips
from models.data.splits import TEST_TRIALS, TRAIN_SUBJECTS, select, without_examination
from models.data.utd_mhad import RecordingError
from models.data.windows import cut_windows
from models.metrics import FRAMES
from models.training import evaluate as evaluation
from models.training import loop
from models.training.calibrate import calibrate, measure_coverage
from models.training.config import PretrainConfig
from models.training.pretrain import choose_device, pretrain, write_pretrained

_TRAIN_SUBJECTS = ",".join(TRAIN_SUBJECTS)
Data = Annotated[
    Path, typer.Option(help="Folder or zip of UTD-MHAD, or an .npz of the documented keys.")
]
Mix = Annotated[
    Path | None,
    typer.Option(help="More people to train on (.npz or a folder of them); examinees never train."),
]
Subjects = Annotated[str | None, typer.Option(help="Subjects, such as 1,3,5,7.")]
Json = Annotated[Path | None, typer.Option("--json", help="Write the figures here; - prints them.")]


def pretrain_command(
    data: Data,
    out_file: Annotated[Path, typer.Option("--out", help="The checkpoint to write.")],
    subjects: Subjects = _TRAIN_SUBJECTS,
    mix: Mix = None,
    leave_out: Annotated[
        str, typer.Option(help="People to validate on and never train on, such as utd-mhad/7.")
    ] = "",
    steps: Annotated[int | None, typer.Option(min=1, help="Optimisation steps.")] = None,
    batch: Annotated[int | None, typer.Option(min=1, help="Windows in a step.")] = None,
    seed: Annotated[int, typer.Option(help="Of weights, sampling and augmentation.")] = 0,
    patience: Annotated[
        int | None, typer.Option(min=1, help="Stop after so many validations without gain.")
    ] = None,
    *,
    adversary: Annotated[
        bool, typer.Option("--adversary/--no-adversary", help="Play the adversarial game.")
    ] = True,
) -> None:
    """Train a base model on recordings (phase 1); a killed run goes on where it was."""
    _refuse_place("--out", out_file)
    config = _configure(steps=steps, batch=batch, seed=seed, adversary=adversary, patience=patience)
    clips = _read(data, subjects)
    if mix is not None:
        clips += without_examination(_read(mix, None))
    left_out = [_person(name) for name in leave_out.split(",") if name]
    state = out_file.with_suffix(".state")
    if state.exists():
        out.print(f"Going on from {state}")
    out.print(f"{len(clips)} clips, on {choose_device()}")
    with progress_bar("pretraining") as report:
        try:
            result = pretrain(clips, config, leave_out=left_out, report=report, state=state)
        except ValueError as error:
            fail(str(error), status=2)
    sha256 = write_pretrained(out_file, result, command=_command_line())
    state.unlink(missing_ok=True)
    out.print(f"{out_file}  {out_file.stat().st_size / 1e6:.2f} MB  sha256 {sha256}")


def calibrate_command(
    model: Annotated[Path, typer.Option(help="The checkpoint that gets the table of radii.")],
    data: Data,
    fold: Annotated[
        list[Path], typer.Option(help="A base trained with people left out; may be repeated.")
    ],
) -> None:
    """Measure the radius on people whom other bases left out, and write it into a model."""
    try:
        base = load_checkpoint(model)
        radius, scores = calibrate([load_checkpoint(path) for path in fold], _read(data, None))
    except (OSError, ValueError) as error:
        fail(str(error), status=2)
    metadata = base.metadata | {"left_out_scores": scores}
    sha256 = save_checkpoint(
        model, base.predictor, metadata, radius=radius, adversary=base.adversary
    )
    at = float(radius.radius(0.9)[-1].mean()) * 100
    out.print(f"{model}  sha256 {sha256}\nradius at 0.5 s and coverage 0.9: {at:.1f} cm on average")


def evaluate_command(
    data: Data,
    subjects: Subjects = None,
    test_trials: Annotated[
        str | None, typer.Option(help="Trials to test on; 2,3,4 of UTD-MHAD, all of an .npz.")
    ] = None,
    model: Annotated[Path, typer.Option(help="The checkpoint to score.")] = SHIPPED,
    json_out: Json = None,
    *,
    baselines: Annotated[
        bool, typer.Option("--baselines", help="Score damped velocity and ridge as well.")
    ] = False,
) -> None:
    """Print the error table of a model: cm² and mm, by subject and frame, against baselines."""
    if json_out is not None and str(json_out) != "-":
        _refuse_place("--json", json_out)
        if not json_out.parent.is_dir():
            fail(f"--json: there is no folder {json_out.parent}", status=2)
    try:
        checkpoint = load_checkpoint(model)
    except (OSError, CheckpointError) as error:
        fail(f"{model}: {error}", status=2)
    everybody = _read(data, None)
    trials = test_trials.split(",") if test_trials else _default_trials(data)
    test = select(everybody, subjects=subjects.split(",") if subjects else None, trials=trials)
    if not test:
        wanted = f"subjects {subjects or 'any'} and trials {','.join(trials or ['any'])}"
        fail(f"no clips of {wanted} in {data}", status=2)
    rows = _score(checkpoint, everybody, test, by_subject=bool(subjects), more=baselines)
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
    return sorted(rows, key=lambda row: (len(row.subject), row.subject))


def _with_coverage(
    row: evaluation.Row, checkpoint: Checkpoint, test: Sequence[Clip]
) -> evaluation.Row:
    if checkpoint.radius is None:
        return row
    own = test if row.subject == evaluation.EVERYBODY else select(test, subjects=[row.subject])
    windows = cut_windows(own, checkpoint.predictor.spec)
    found = measure_coverage(checkpoint.predictor, checkpoint.radius, windows)
    return replace(row, coverage=found)


def progress_bar(name: str) -> "_Bar":
    """Make a progress bar with loss and validation error for a training run."""
    return _Bar(name)


class _Bar:
    def __init__(self, name: str) -> None:
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.completed}/{task.total} loss {task.fields[loss]:.4f}"),
            TextColumn("{task.fields[validation]}"),
            TimeRemainingColumn(),
            console=err,
            refresh_per_second=2,
        )
        self._task = self._bar.add_task(name, total=None, loss=float("nan"), validation="")

    def __enter__(self) -> "_Bar":
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def __call__(self, now: loop.Progress) -> None:
        self._bar.update(self._task, completed=now.step, total=now.steps, loss=now.loss)
        if now.validation is not None:
            text = f"left out {now.validation:.2f} cm²"
            self._bar.update(self._task, validation=text)
            if not err.is_terminal:
                out.print(f"step {now.step}/{now.steps}  loss {now.loss:.4f}  {text}")


def _configure(
    *, steps: int | None, batch: int | None, seed: int, adversary: bool, patience: int | None
) -> PretrainConfig:
    config = replace(PretrainConfig(), seed=seed, patience=patience)
    if steps is not None:
        config = replace(config, steps=steps)
    if batch is not None:
        config = replace(config, batch=batch)
    return config if adversary else replace(config, adversarial_weight=0.0)


def _read(path: Path, subjects: str | None) -> list[Clip]:
    try:
        return load_clips(path, subjects=subjects.split(",") if subjects else None)
    except (OSError, RecordingError) as error:
        fail(str(error), status=2)


def _refuse_place(option: str, path: Path) -> None:
    """Refuse what no file can be written to, before hours of computing rather than after."""
    if path.is_dir():
        fail(f"{option}: {path} is a folder, not a file", status=2)
    nearest = next(folder for folder in path.absolute().parents if folder.exists())
    if not nearest.is_dir():
        fail(f"{option}: {nearest} is no folder", status=2)
    if not os.access(nearest, os.W_OK | os.X_OK):
        fail(f"{option}: nothing may be written in {nearest}", status=2)


def _person(name: str) -> tuple[str, str]:
    source, slash, subject = name.partition("/")
    if not slash:
        fail(f"{name!r} is no person: write collection/subject, such as utd-mhad/7", status=2)
    return source, subject


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


def _command_line() -> str:
    return shlex.join(["kinecast", *sys.argv[1:]])
