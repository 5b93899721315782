"""`kinecast demo`: see forecasts happen, without a sensor and without recordings."""

import asyncio
import json
import signal
import time
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.console import Console
from rich.live import Live

from app.commands.client.errors import ApiError, ClientError, ClosedError
from app.commands.client.messages import SUBPROTOCOLS
from app.commands.client.rest import Api
from app.commands.demo.person import RATE_HZ, Performer, Report
from app.commands.demo.view import describe_plainly, draw, to_figures
from app.commands.output import err, fail, out
from app.commands.target import Target, find_target

REFRESH_S = 0.25
PLAIN_S = 2.0
"""How often lines are written where there is no terminal to draw on."""
FORBIDDEN = 403


def demo_command(
    *,
    users: Annotated[int, typer.Option(min=1, max=64, help="How many people.")] = 3,
    url: Annotated[
        str | None, typer.Option(help="The service.", show_default="http://127.0.0.1:8000")
    ] = None,
    key: Annotated[
        str | None, typer.Option(help="API key; by default KINECAST_KEY.", show_default=False)
    ] = None,
    seconds: Annotated[
        float | None, typer.Option(min=0.1, help="How long; by default until Ctrl+C.")
    ] = None,
    wire: Annotated[
        Literal["msgpack", "json"], typer.Option("--format", help="What the stream speaks.")
    ] = "msgpack",
    data_dir: Annotated[
        Path | None,
        typer.Option(help="Folder of a service on this machine: its key.", show_default="var"),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the figures at the end.")] = False,
) -> None:
    """Stream synthetic people to a service, record them, and show how well it foresees them."""
    target = find_target(url=url, key=key, data_dir=data_dir)
    performers = [Performer(f"demo-{n}", seed=n) for n in range(1, users + 1)]
    reports = [performer.report for performer in performers]
    console = err if as_json else out
    try:
        seconds_run = asyncio.run(
            _run(performers, target, SUBPROTOCOLS[wire], seconds=seconds, console=console)
        )
    except ClosedError as error:
        fail(_explain_refusal(error), status=1)
    except ClientError as error:
        hint = "" if url else " Start one with `kinecast serve`, or give --url."
        fail(f"{error}{hint}", status=1)
    if as_json:
        figures = {"seconds": round(seconds_run, 1), "people": [to_figures(r) for r in reports]}
        typer.echo(json.dumps(figures, indent=2))
    if not any(report.answered for report in reports):
        fail("No forecast came.", status=1)


async def _run(
    performers: Sequence[Performer],
    target: Target,
    subprotocol: str,
    *,
    seconds: float | None,
    console: Console,
) -> float:
    """Let everybody perform until time is up or somebody interrupts; gives the seconds."""
    reports = [performer.report for performer in performers]
    await _add_users(target, [report.user for report in reports])
    started = time.monotonic()
    async with _stop_signal() as stop:
        tasks = [
            asyncio.create_task(
                performer.perform(
                    target.url,
                    key=target.key,
                    subprotocol=subprotocol,
                    start=started + n / len(performers) / RATE_HZ,
                )
            )
            for n, performer in enumerate(performers)
        ]
        view = asyncio.create_task(_show(reports, console, url=target.url, started=started))
        waits = [asyncio.create_task(stop.wait()), *tasks, view]
        try:
            done, _ = await asyncio.wait(
                waits, timeout=seconds, return_when=asyncio.FIRST_COMPLETED
            )
        finally:
            for task in waits:
                task.cancel()
            await asyncio.gather(*waits, return_exceptions=True)
    for task in done:
        if not task.cancelled():
            task.result()  # a performer who was refused
    return time.monotonic() - started


async def _add_users(target: Target, users: Sequence[str]) -> None:
    """Create the people where the key may; with another key they have to be there already."""
    async with Api(target.url, key=target.key) as api:
        for user in users:
            try:
                await api.add_user(user, display_name=f"Synthetic {user}")
            except ApiError as error:
                if error.status != FORBIDDEN:
                    raise
                return


async def _show(reports: Sequence[Report], console: Console, *, url: str, started: float) -> None:
    """Show the state until cancelled, and once more at the end."""
    if not console.is_terminal:
        await _write_lines(reports, console)
        return
    with Live(console=console, auto_refresh=False, transient=False) as live:

        def refresh() -> None:
            elapsed_s = time.monotonic() - started
            picture = draw(reports, url=url, elapsed_s=elapsed_s, width=console.width)
            live.update(picture, refresh=True)

        try:
            while True:
                refresh()
                await asyncio.sleep(REFRESH_S)
        finally:
            refresh()


async def _write_lines(reports: Sequence[Report], console: Console) -> None:
    try:
        while True:
            await asyncio.sleep(PLAIN_S)
            for report in reports:
                console.print(describe_plainly(report), markup=False)
    finally:
        console.print("At the end:", markup=False)
        for report in reports:
            console.print(describe_plainly(report), markup=False)


@asynccontextmanager
async def _stop_signal() -> AsyncIterator[asyncio.Event]:
    """Give an event that Ctrl+C or a request to stop sets."""
    loop, stop = asyncio.get_running_loop(), asyncio.Event()
    signals = (signal.SIGINT, signal.SIGTERM)
    for number in signals:
        loop.add_signal_handler(number, stop.set)
    try:
        yield stop
    finally:
        for number in signals:
            loop.remove_signal_handler(number)


def _explain_refusal(error: ClosedError) -> str:
    if error.code in {"forbidden", "unknown_user"}:
        return f"{error} The demo makes its own users and needs an admin key for that."
    return str(error)
