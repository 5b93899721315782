"""`kinecast pretrain` and `kinecast calibrate`: how a base comes about."""

import shlex
import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from app.commands.files import read_clips, read_more_people, refuse_place
from app.commands.output import err, fail, out
from models.checkpoint import load_checkpoint, save_checkpoint
from models.data.splits import TRAIN_SUBJECTS
from models.training import loop
from models.training.calibrate import calibrate
from models.training.config import PretrainConfig
from models.training.pretrain import choose_device, pretrain, write_pretrained

TRAINED_ON = ",".join(TRAIN_SUBJECTS)
Data = Annotated[
    Path, typer.Option(help="Folder or zip of UTD-MHAD, or an .npz of the documented keys.")
]
Mix = Annotated[
    Path | None,
    typer.Option(
        help="More people to train on (.npz or a folder of them), without those who only test."
    ),
]
Subjects = Annotated[str | None, typer.Option(help="Subjects, such as 1,3,5,7.")]
Json = Annotated[Path | None, typer.Option("--json", help="Write the figures here; - prints them.")]


def pretrain_command(
    data: Data,
    out_file: Annotated[Path, typer.Option("--out", help="The checkpoint to write.")],
    subjects: Subjects = TRAINED_ON,
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
    refuse_place("--out", out_file)
    config = _configure(steps=steps, batch=batch, seed=seed, adversary=adversary, patience=patience)
    clips = read_clips(data, subjects) + read_more_people(mix)
    left_out = parse_people(leave_out)
    state = out_file.with_suffix(".state")
    if state.exists():
        out.print(f"Going on from {state}")
    out.print(f"{len(clips)} clips, on {choose_device()}")
    with progress_bar("pretraining") as report:
        try:
            result = pretrain(clips, config, leave_out=left_out, report=report, state=state)
        except ValueError as error:
            fail(str(error), status=2)
    sha256 = write_pretrained(out_file, result, command=command_line())
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
        radius, scores = calibrate([load_checkpoint(path) for path in fold], read_clips(data, None))
    except (OSError, ValueError) as error:
        fail(str(error), status=2)
    metadata = base.metadata | {"left_out_scores": scores}
    sha256 = save_checkpoint(
        model, base.predictor, metadata, radius=radius, adversary=base.adversary
    )
    at = float(radius.radius(0.9)[-1].mean()) * 100
    out.print(f"{model}  sha256 {sha256}\nradius at 0.5 s and coverage 0.9: {at:.1f} cm on average")


def parse_people(names: str) -> list[tuple[str, str]]:
    """Read people, such as utd-mhad/7,precog/5, as (source, subject); on failure exit."""
    return [_person(name) for name in names.split(",") if name]


def command_line() -> str:
    """Give the command that runs, for the metadata of what it makes."""
    return shlex.join(["kinecast", *sys.argv[1:]])


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


def _person(name: str) -> tuple[str, str]:
    source, slash, subject = name.partition("/")
    if not slash:
        fail(f"{name!r} is no person: write collection/subject, such as utd-mhad/7", status=2)
    return source, subject
