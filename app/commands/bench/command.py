"""The commands of `kinecast bench`."""

import json
from typing import Annotated, Any, Literal

import typer
from rich.table import Table

from app.commands.client.errors import ClientError
from app.commands.output import err, fail, out
from app.commands.target import Target, find_target
from app.settings import load_settings

app = typer.Typer(
    help="Measure the service, or the forecaster alone; figures as JSON.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

AsJson = Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")]


@app.command("stream")
def stream_command(
    *,
    users: Annotated[int, typer.Option(min=1, max=1000, help="Streams at the same time.")] = 1,
    seconds: Annotated[float, typer.Option(min=1.0, help="Length of each run.")] = 20.0,
    repeats: Annotated[int, typer.Option(min=1, max=100, help="Runs.")] = 3,
    form: Annotated[
        Literal["msgpack", "json"], typer.Option("--format", help="What the streams speak.")
    ] = "msgpack",
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
    reported, and the figures are given with and without the forecasts that met one.
    """
    from app.commands.bench.stream import (  # noqa: PLC0415
        Settle,
        StreamPlan,
        measure_stream,
        own_target,
    )
    from app.commands.own_server import OwnServerError  # noqa: PLC0415 - slow to import

    plan = StreamPlan(users=users, seconds=seconds, repeats=repeats, form=form)

    def measure(target: Target, settle: Settle | None) -> dict[str, Any]:
        with err.status(f"{repeats} runs of {seconds:g} s with {users} streams"):
            return measure_stream(plan, target, settle=settle)

    try:
        if url is None:
            with own_target(users) as (target, settle):
                report = measure(target, None if base else settle)
        else:
            report = measure(find_target(url=url, key=key), None)
    except (ClientError, OwnServerError, TimeoutError) as error:
        fail(str(error) or "The measurement took too long.", status=1)
    _print(report, as_json=as_json, table=_tabulate_stream)


@app.command("forecast")
def forecast_command(
    *,
    users: Annotated[str, typer.Option(help="Numbers of people at once.")] = "1,8,32,128",
    repeats: Annotated[int, typer.Option(min=5, help="Calls of each kind.")] = 300,
    seconds: Annotated[float, typer.Option(min=0.1, help="Most seconds for each kind.")] = 10.0,
    as_json: AsJson = False,
) -> None:
    """Time forecasts alone, everybody by an own decoder: PyTorch, and the kernel in every form.

    The floor is what the bytes and operations of a forecast take at the rates that this processor
    is measured to reach in the same run.
    """
    from app.commands.bench.forecast import ForecastPlan, measure_forecast  # noqa: PLC0415

    settings = load_settings()
    plan = ForecastPlan(
        users=_read_numbers(users),
        repeats=repeats,
        seconds=seconds,
        threads=settings.engine_threads,
        model=settings.model,
    )
    with err.status("forecasting"):
        report = measure_forecast(plan)
    _print(report, as_json=as_json, table=_tabulate_forecast)


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
    _print(report, as_json=as_json, table=_tabulate_finetune)


def _read_numbers(text: str) -> list[int]:
    try:
        numbers = [int(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if not numbers or min(numbers) < 1 or max(numbers) > 4096:
        fail(f"--users {text}: write numbers from 1 to 4096, such as 1,8,32.", status=2)
    return numbers


def _print(report: dict[str, Any], *, as_json: bool, table: Any) -> None:  # noqa: ANN401 - a function
    if as_json:
        typer.echo(json.dumps(report, indent=2))
    else:
        out.print(table(report))


def _tabulate_stream(report: dict[str, Any]) -> Table:
    streams = "1 stream" if report["users"] == 1 else f"{report['users']} streams"
    table = Table(
        "run", "p50", "p99", "p99.9", "max ms", "in time", "missed", "skipped", "lost", "| pauses",
        "p99", "in time",
        title=f"{streams} at 30 Hz for {report['seconds']:g} s, {report['format']}",
        caption="in time: within 33 ms · right of the bar: without the machine's own pauses",
        box=None, pad_edge=False, collapse_padding=True,
    )  # fmt: skip
    for number, run in enumerate(report["runs"], start=1):
        latency, clean = run["latency_ms"], run["without_pauses"]
        table.add_row(
            str(number),
            *(_milliseconds(latency[name]) for name in ("p50", "p99", "p99_9", "max")),
            _percent(run["within_33_ms"]),
            str(run["misses"]),
            str(run["frames"]["skipped"]),
            str(run["frames"]["unanswered"]),
            f"| {run['host']['pauses']}",
            _milliseconds(clean["latency_ms"]["p99"]),
            _percent(clean["within_33_ms"]),
        )
    return table


def _tabulate_forecast(report: dict[str, Any]) -> Table:
    table = Table(
        "people", "way", "forecasts/s", "µs each, median", "p99", "eager", "floor µs", "floor",
        title=f"{report['threads']} thread, {report['cores']} cores", box=None, pad_edge=False,
    )  # fmt: skip
    for row in report["rows"]:
        each = row["us_per_forecast"]
        table.add_row(
            str(row["users"]),
            row["way"],
            str(row["forecasts_per_s"]),
            f"{each['median']:.0f}",
            f"{each['p99']:.0f}",
            f"{row['times_eager']:.1f} x faster",
            "" if row["floor_us"] is None else f"{row['floor_us']:.0f}",
            "" if row["times_floor"] is None else f"{row['times_floor']:.1f} x",
        )
    return table


def _tabulate_finetune(report: dict[str, Any]) -> Table:
    table = Table(
        "people", "clips", "steps", "seconds, median", "max", "ms per step", "peak MB", "KB each",
        title=f"{report['threads']} thread, {report['cores']} cores", box=None, pad_edge=False,
    )  # fmt: skip
    seconds = report["seconds"]
    table.add_row(
        str(report["users"]),
        str(report["clips"]),
        str(report["steps"]),
        f"{seconds['p50']:.1f}",
        f"{seconds['max']:.1f}",
        f"{report['ms_per_step']:.1f}",
        str(report["peak_memory_mb"]),
        str(report["bytes_per_version"] // 1000),
    )
    return table


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{share:.1%}"


def _milliseconds(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"
