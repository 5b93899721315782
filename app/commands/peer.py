"""`kinecast pretrain-peer`: the net of others that the table of errors is compared with."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from app.commands.files import read_clips, read_more_people, refuse_place
from app.commands.output import fail, out
from app.commands.training import (
    TRAINED_ON,
    Data,
    Mix,
    Subjects,
    command_line,
    parse_people,
    progress_bar,
)
from models.training.simlpe import SimlpeConfig, train_simlpe
from models.training.simlpe_file import save_simlpe


def pretrain_peer_command(
    data: Data,
    out_file: Annotated[Path, typer.Option("--out", help="The safetensors file to write.")],
    subjects: Subjects = TRAINED_ON,
    mix: Mix = None,
    leave_out: Annotated[
        str, typer.Option(help="People to validate on and never train on, such as utd-mhad/7.")
    ] = "",
    steps: Annotated[int | None, typer.Option(min=1, help="Optimisation steps.")] = None,
    seed: Annotated[int, typer.Option(help="Of weights, sampling and augmentation.")] = 0,
) -> None:
    """Train siMLPe, the peer, on the data of a base, for `kinecast evaluate --simlpe`."""
    refuse_place("--out", out_file)
    config = replace(SimlpeConfig(), seed=seed)
    config = config if steps is None else replace(config, steps=steps)
    clips = read_clips(data, subjects) + read_more_people(mix)
    with progress_bar("training siMLPe") as report:
        try:
            result = train_simlpe(clips, config, leave_out=parse_people(leave_out), report=report)
        except ValueError as error:
            fail(str(error), status=2)
    sha256 = save_simlpe(out_file, result.net, result.metadata | {"command": command_line()})
    out.print(f"{out_file}  {out_file.stat().st_size / 1e3:.0f} kB  sha256 {sha256}")
