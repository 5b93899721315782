"""The command line. What is slow to import waits until its command runs, so help is instant."""

import importlib
from typing import Annotated, NamedTuple

import typer

from app.commands import db, keys, serve
from app.commands.output import fail
from app.domain.errors import KinecastError, StartError
from app.settings import BadSettingsError
from app.version import read_version


class Lazy(NamedTuple):
    """A command whose module is imported when it runs.

    Attributes:
        name: of the command.
        module: where it is.
        attribute: the function, or the Typer application of a group of commands.
        help: its line in the list of commands.
    """

    name: str
    module: str
    attribute: str
    help: str


LAZY = (
    Lazy(
        "pretrain",
        "app.commands.training",
        "pretrain_command",
        "Train a base model on recordings (phase 1).",
    ),
    Lazy(
        "pretrain-peer",
        "app.commands.peer",
        "pretrain_peer_command",
        "Train siMLPe, which a base is compared with.",
    ),
    Lazy(
        "calibrate",
        "app.commands.training",
        "calibrate_command",
        "Measure the radius of a model on people left out.",
    ),
    Lazy(
        "evaluate",
        "app.commands.evaluate",
        "evaluate_command",
        "Print the error table of a model on recordings.",
    ),
    Lazy(
        "worker",
        "app.commands.worker",
        "worker_command",
        "Fine-tune for the same database as the service.",
    ),
    Lazy(
        "import",
        "app.commands.import_",
        "import_command",
        "Upload recordings as trials.",
    ),
    Lazy(
        "demo",
        "app.commands.demo.command",
        "demo_command",
        "Stream synthetic people and show how well they are foreseen.",
    ),
    Lazy(
        "bench",
        "app.commands.bench.command",
        "app",
        "Measure the service, or the forecaster alone.",
    ),
)

app = typer.Typer(
    name="kinecast",
    help="Forecasts how a person will move in the next half second, and learns each person.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,  # they would print keys and poses
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command("serve")(serve.serve)
app.add_typer(keys.app, name="keys")
app.add_typer(db.app, name="db")


def load_command(lazy: Lazy) -> typer.Typer:
    """Import a command."""
    target = getattr(importlib.import_module(lazy.module), lazy.attribute)
    if isinstance(target, typer.Typer):
        return target
    made = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    made.command(context_settings={"help_option_names": ["-h", "--help"]})(target)
    return made


def _add_lazily(lazy: Lazy) -> None:
    """Register a command that hands its arguments on to the real one."""

    @app.command(
        lazy.name,
        help=lazy.help,
        add_help_option=False,
        context_settings={"allow_extra_args": True, "ignore_unknown_options": True},
    )
    def run(context: typer.Context) -> None:
        load_command(lazy)(args=context.args, prog_name=f"kinecast {lazy.name}")


for _lazy in LAZY:
    _add_lazily(_lazy)


def _show_version(wanted: bool) -> bool:  # noqa: FBT001 - the signature is Typer's
    if wanted:
        typer.echo(f"kinecast {read_version()}")
        raise typer.Exit
    return wanted


@app.callback()
def root(
    *,
    show_version: Annotated[
        bool,
        typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version."),
    ] = False,
) -> None:
    """Forecasts how a person will move in the next half second, and learns each person."""
    del show_version


def main() -> None:
    """Run the command line; what can go wrong on purpose is one line and no traceback."""
    try:
        app()
    except BadSettingsError as error:
        fail(str(error), status=2)
    except StartError as error:
        fail(error.message, status=2)
    except KinecastError as error:
        fail(error.message, status=1)
    except OSError as error:
        if error.filename is None:  # no place that somebody named, so a defect
            raise
        fail(_explain_place(error), status=2)


def _explain_place(error: OSError) -> str:
    if isinstance(error, FileExistsError):  # made a folder where a file is
        return f"{error.filename} is no folder."
    return f"Cannot use {error.filename}: {error.strerror}."


if __name__ == "__main__":
    main()
