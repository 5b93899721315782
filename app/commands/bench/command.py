"""The commands of `kinecast bench`."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from app.commands.bench import tables
from app.commands.client.errors import ClientError
from app.commands.output import err, fail, out
from app.commands.target import find_target
from app.settings import load_settings

if TYPE_CHECKING:
    from app.commands.bench.scenarios import Scenario
    from app.commands.bench.stream import Subject

app = typer.Typer(
    help="Measure the service, or the forecaster alone; figures as JSON.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

_TABLE_WIDTH = 130
"""Tables keep this width, and are cut into lines by terminals that have less."""

_TABLE_WIDTH = 130
"""Tables keep this width, and are cut into lines by terminals that have less."""

AsJson = Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")]


@app.command("stream")
def stream_command(
    *,
    users: Annotated[
        str, typer.Option(help="Streams at the same time; several numbers give a curve.")
    ] = "1",
    seconds: Annotated[float, typer.Option(min=1.0, help="Length of each run.")] = 20.0,
    repeats: Annotated[int, typer.Option(min=1, max=100, help="Runs of each number.")] = 3,
    form: Annotated[
        Literal["msgpack", "json"], typer.Option("--format", help="What the streams speak.")
    ] = "msgpack",
    scenarios: Annotated[
        str,
        typer.Option(
            "--with",
            help="What happens besides, such as swaps,churn: any of swaps (every user's version "
            "changes each 10 s), churn (each second 5 % of the users leave and come back), slow "
            "(10 % of the clients read slowly), finetune (a job runs all the time).",
            show_default=False,
        ),
    ] = "",
    base: Annotated[bool, typer.Option("--base", help="Let the base answer everybody.")] = False,
    url: Annotated[
        str | None, typer.Option(help="A running service, in place of one of its own.")
    ] = None,
    key: Annotated[
        str | None, typer.Option(help="Its admin key; by default KINECAST_KEY.", show_default=False)
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Send frames at 30 Hz on their schedule, and time the forecasts from it.

    The service runs in a process of its own, on SQLite in a folder that is thrown away, and every
    user has a decoder of their own. Frames that
    are skipped, refused or never answered count as missed. Pauses of the machine itself are
    reported, and the figures are given with and without the frames that met one.

    With several numbers of users, such as 1,8,32,64, it also tells the largest one at which at
    most 0.1 % of the frames were missed.
    """
    from app.commands.bench.stream import StreamPlan, measure_stream  # noqa: PLC0415

    plan = StreamPlan(
        users=read_numbers(users, most=1000),
        seconds=seconds,
        repeats=repeats,
        form=form,
        scenarios=_read_scenarios(scenarios, can_swap=url is None and not base),
    )
    found = _find_subject(max(plan.users), base=base, url=url, key=key)
    with err.status("starting") as status, found as subject:
        report = measure_stream(plan, subject, progress=status.update)
    _print(report, as_json=as_json, table=tables.tabulate_stream)


@contextmanager
def _find_subject(
    users: int, *, base: bool, url: str | None, key: str | None
) -> Iterator["Subject"]:
    """Give the service to measure; says in one line what goes wrong, and exits."""
    from app.commands.bench.stream import Subject, own_subject  # noqa: PLC0415 - slow to import

    with _failing_in_one_line():
        if url is not None:
            yield Subject(find_target(url=url, key=key))
            return
        with own_subject(users, base=base) as subject:
            yield subject


@contextmanager
def _failing_in_one_line() -> Iterator[None]:
    """Say in one line what goes wrong with a service, and exit."""
    from app.commands.own_server import OwnServerError  # noqa: PLC0415 - slow to import

    try:
        yield
    except (ClientError, OwnServerError, TimeoutError) as error:
        fail(str(error) or "The measurement took too long.", status=1)


@app.command("forecast")
def forecast_command(
    *,
    users: Annotated[str, typer.Option(help="Numbers of people at once.")] = "1,8,32,128",
    repeats: Annotated[int, typer.Option(min=5, help="Calls of each kind.")] = 300,
    seconds: Annotated[float, typer.Option(min=0.1, help="Most seconds for each kind.")] = 10.0,
    as_json: AsJson = False,
) -> None:
    """Time forecasts alone, everybody by an own decoder: PyTorch, and the kernel in every form.

    "served" is a whole version, with its gate and correction. The floor is what the bytes and
    operations of a forecast take at the rates that this processor is measured to reach in the same
    run.
    """
    from app.commands.bench.forecast import ForecastPlan, measure_forecast  # noqa: PLC0415

    settings = load_settings()
    plan = ForecastPlan(
        users=read_numbers(users, most=4096),
        repeats=repeats,
        seconds=seconds,
        threads=settings.engine_threads,
        model=settings.model,
    )
    with err.status("forecasting"):
        report = measure_forecast(plan)
    _print(report, as_json=as_json, table=tables.tabulate_forecast)


@app.command("finetune")
def finetune_command(
    *,
    users: Annotated[int, typer.Option(min=1, max=1000, help="People, one after another.")] = 3,
    clips: Annotated[int, typer.Option(min=1, max=500, help="Clips of each trial.")] = 27,
    seconds: Annotated[float, typer.Option(min=0.5, max=60.0, help="Of each clip.")] = 2.2,
    as_json: AsJson = False,
) -> None:
    """Time whole fine-tuning runs without a service: checks, the judge's fits, the final fit."""
    from app.commands.bench.finetune import FinetunePlan, measure_finetune  # noqa: PLC0415

    settings = load_settings()
    plan = FinetunePlan(
        users=users,
        clips=clips,
        seconds=seconds,
        steps=settings.finetune_steps,
        threads=settings.finetune_threads,
        model=settings.model,
    )
    with err.status(f"fine-tuning {users} decoders"):
        report = measure_finetune(plan)
    _print(report, as_json=as_json, table=tables.tabulate_finetune)


@app.command("memory")
def memory_command(
    *,
    decoders: Annotated[
        str, typer.Option(help="Numbers of cached decoders, about 0.6 MB each.")
    ] = "100,1000,5000",
    active: Annotated[int, typer.Option(min=1, help="How many of them forecast.")] = 100,
    rounds: Annotated[int, typer.Option(min=1, help="Forecasts of each of those.")] = 30,
    users: Annotated[
        int, typer.Option(min=0, max=1000, help="Streams for the memory of a user; 0 for none.")
    ] = 100,
    as_json: AsJson = False,
) -> None:
    """Measure the memory of a connected user and of a cached decoder, and whether many are slower.

    Decoders are built in this process, as the service does it. A user's memory is what a service
    of its own grows by between one stream and many, each user's decoder included.
    """
    from app.commands.bench.memory import MemoryPlan, measure_memory  # noqa: PLC0415

    numbers = read_numbers(decoders, most=100_000, option="--decoders")
    if numbers[0] < active:
        fail(f"--decoders {decoders}: {active} forecast, so there are no fewer.", status=2)
    if users == 1:
        fail("--users 1: it takes two to tell what one more takes.", status=2)
    plan = MemoryPlan(
        decoders=numbers,
        active=active,
        rounds=rounds,
        users=users,
        model=load_settings().model,
    )
    with _failing_in_one_line(), err.status("starting") as status:
        report = measure_memory(plan, progress=status.update)
    _print(report, as_json=as_json, table=tables.tabulate_memory)


@app.command("start")
def start_command(
    *,
    starts: Annotated[int, typer.Option(min=1, max=100, help="Starts of the service.")] = 5,
    users: Annotated[
        int, typer.Option(min=1, max=500, help="People who ask in each, in each of two ways.")
    ] = 20,
    as_json: AsJson = False,
) -> None:
    """Time the start of a service, and the first forecast of people whose decoders it has not.

    The database is there already and has everybody's version. Half of the people ask over HTTP,
    the others open a stream and send half a second of frames at once.
    """
    from app.commands.bench.start import StartPlan, measure_start  # noqa: PLC0415

    with _failing_in_one_line(), err.status("starting") as status:
        report = measure_start(StartPlan(starts=starts, users=users), progress=status.update)
    _print(report, as_json=as_json, table=tables.tabulate_start)


def _read_scenarios(text: str, *, can_swap: bool) -> frozenset["Scenario"]:
    """Read what is to happen besides; says in one line what is wrong with it, and exits."""
    from app.commands.bench.scenarios import Scenario, read_scenarios  # noqa: PLC0415

    try:
        scenarios = read_scenarios(text)
    except ValueError:
        fail(f"--with {text}: choose of {', '.join(Scenario)}.", status=2)
    if Scenario.SWAPS in scenarios and not can_swap:
        fail("--with swaps needs the versions of a service of its own.", status=2)
    return scenarios


def read_numbers(text: str, *, most: int, option: str = "--users") -> list[int]:
    """Read numbers of people; says in one line what is wrong with them, and exits."""
    try:
        numbers = [int(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if not numbers or min(numbers) < 1 or max(numbers) > most:
        fail(f"{option} {text}: write numbers from 1 to {most}, such as 1,8,32.", status=2)
    return sorted(set(numbers))


def _print(report: dict[str, Any], *, as_json: bool, table: Any) -> None:  # noqa: ANN401 - a function
    if as_json:
        typer.echo(json.dumps(report, indent=2))
    else:
        out.width = max(out.width, _TABLE_WIDTH)
        out.print(table(report))
