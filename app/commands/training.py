"""`kinecast pretrain`, `kinecast calibrate` and `kinecast evaluate`: what a researcher runs."""

import json
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import torch
import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from models.baselines import Forecaster
from models.checkpoint import SHIPPED, CheckpointError, load_checkpoint
from models.data.clips import Clip, load_clips
from models.data.splits import TEST_TRIALS, TRAIN_SUBJECTS, select, without_examination
from models.data.utd_mhad import RecordingError
from models.metrics import FRAMES
from models.training import evaluate as evaluation
from models.training import loop
from models.training.config import PretrainConfig
from models.training.pretrain import choose_device, pretrain, write_pretrained

_TRAIN_SUBJECTS = ",".join(TRAIN_SUBJECTS)
console = Console()
errors = Console(stderr=True)

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
    out: Annotated[Path, typer.Option(help="The checkpoint to write.")],
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
    config = _configure(steps=steps, batch=batch, seed=seed, adversary=adversary, patience=patience)
    clips = _read(data, subjects)
    if mix is not None:
        clips += without_examination(_read(mix, None))
    left_out = [_person(name) for name in leave_out.split(",") if name]
    state = out.with_suffix(".state")
    if state.exists():
        console.print(f"Going on from {state}")
    console.print(f"{len(clips)} clips, on {choose_device()}")
    with progress_bar("pretraining") as report:
        try:
            result = pretrain(clips, config, leave_out=left_out, report=report, state=state)
        except ValueError as error:
            raise fail(str(error)) from error
    sha256 = write_pretrained(out, result, command=_command_line())
    state.unlink(missing_ok=True)
    console.print(f"{out}  {out.stat().st_size / 1e6:.2f} MB  sha256 {sha256}")


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
    try:
        checkpoint = load_checkpoint(model)
    except (OSError, CheckpointError) as error:
        raise fail(f"{model}: {error}") from error
    everybody = _read(data, None)
    trials = test_trials.split(",") if test_trials else _default_trials(data)
    test = select(everybody, subjects=subjects.split(",") if subjects else None, trials=trials)
    if not test:
        raise fail(
            f"no clips of subjects {subjects or 'any'} and trials {trials or 'any'} in {data}"
        )
    torch.manual_seed(0)
    rows = _score(checkpoint.predictor, everybody, test, by_subject=bool(subjects), more=baselines)
    description = {"file": model.name, "sha256": checkpoint.sha256}
    protocol = evaluation.describe_protocol(test, model=description)
    report = {"protocol": protocol, "rows": [row.as_json() for row in rows]}
    if json_out is not None:
        _write_json(json_out, report)
    if json_out is None or str(json_out) != "-":
        console.print(_table(rows, published=_is_paper_protocol(data, trials)))


def _score(
    predictor: Forecaster,
    everybody: Sequence[Clip],
    test: Sequence[Clip],
    *,
    by_subject: bool,
    more: bool,
) -> list[evaluation.Row]:
    methods: dict[str, Forecaster] = {"base": predictor}
    methods |= evaluation.simple_baselines() if more else {}
    rows = evaluation.evaluate(methods, test, by_subject=by_subject)
    training = [clip for clip in evaluation.training_clips(everybody) if clip.source == "utd-mhad"]
    if more and by_subject and training:
        rows += evaluation.evaluate_ridge(training, everybody, test)
    elif more:
        errors.print("ridge needs UTD-MHAD's subjects 1, 3, 5, 7 to be fitted on: left out")
    return sorted(rows, key=lambda row: (len(row.subject), row.subject))


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
            console=console,
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
            if not console.is_terminal:
                console.print(f"step {now.step}/{now.steps}  loss {now.loss:.4f}  {text}")


def fail(message: str) -> typer.Exit:
    """Say in one line on standard error what was wrong; raise the result to exit with 2."""
    errors.print(f"[red]kinecast:[/red] {message}", highlight=False, soft_wrap=True)
    return typer.Exit(2)


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
        raise fail(str(error)) from error


def _person(name: str) -> tuple[str, str]:
    source, slash, subject = name.partition("/")
    if not slash:
        raise fail(f"{name!r} is no person: write collection/subject, such as utd-mhad/7")
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


def _table(rows: Sequence[evaluation.Row], *, published: bool) -> Table:
    table = Table(
        title="mean squared error in cm², cumulative (at frame; mm)", title_justify="left"
    )
    for heading in ("subject", "method"):
        table.add_column(heading, no_wrap=True)
    for frame in FRAMES:
        table.add_column(f"{frame}\n{frame * 1000 / 30:.0f} ms", justify="right")
    for subject in dict.fromkeys(row.subject for row in rows):
        for row in rows:
            if row.subject == subject:
                table.add_row(subject, row.method, *_cells(row))
        for (name, whose), values in evaluation.PUBLISHED.items():
            if published and whose == subject:
                table.add_row(
                    subject, f"[dim]{name}[/dim]", *(f"[dim]{v:.2f}[/dim]" for v in values)
                )
        table.add_section()
    return table


def _cells(row: evaluation.Row) -> list[str]:
    scores = row.scores
    values = zip(scores.mse_cm2, scores.mse_cm2_at, scores.mpjpe_mm, strict=True)
    return [f"{total:.2f} [dim]({at:.1f}; {mm:.0f})[/dim]" for total, at, mm in values]


def _command_line() -> str:
    return shlex.join(["kinecast", *sys.argv[1:]])
