"""`kinecast worker`: one more process that fine-tunes, for the same database."""

import asyncio
import contextlib
import os
import platform
import signal
import sys
import threading
from pathlib import Path
from typing import Annotated
from uuid import uuid4

import typer

from app.settings import Settings, load_settings


def worker_command(
    data_dir: Annotated[
        Path | None, typer.Option(help="Folder of the SQLite database.", show_default="var")
    ] = None,
    *,
    once: Annotated[
        bool, typer.Option("--once", help="End when there is nothing left to do.")
    ] = False,
    tied: Annotated[bool, typer.Option("--tied", hidden=True)] = False,
) -> None:
    """Fine-tune for the same database as the service, until stopped."""
    from app.logs import configure_logs  # noqa: PLC0415 - slow to import

    settings = load_settings(data_dir=data_dir)
    configure_logs(settings)
    asyncio.run(_run(settings, once=once, tied=tied))


async def _run(settings: Settings, *, once: bool, tied: bool) -> None:
    from app.storage.database import Database  # noqa: PLC0415 - slow to import
    from app.storage.migrate import check_current  # noqa: PLC0415
    from app.worker.loop import Worker  # noqa: PLC0415
    from app.worker.setup import make_rules, store_base  # noqa: PLC0415

    stop = asyncio.Event()
    _stop_on_signals(stop, tied=tied)
    database = Database.from_settings(settings)
    owner = f"{platform.node()}/{os.getpid()}/{uuid4().hex[:8]}"
    try:
        await check_current(database)
        rules = make_rules(settings, owner=owner)
        await store_base(database, rules.base)
        database.announcements.start()
        worker = Worker(database, rules, stop)
        if once:
            await worker.run_pending()
        else:
            await worker.run()
    finally:
        await database.close()


def _stop_on_signals(stop: asyncio.Event, *, tied: bool) -> None:
    """Leave politely when asked to, or when the service that started this one is gone."""
    loop = asyncio.get_running_loop()
    for name in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(name, stop.set)
    if tied:
        threading.Thread(target=_wait_for_end, args=(loop, stop), daemon=True).start()


def _wait_for_end(loop: asyncio.AbstractEventLoop, stop: asyncio.Event) -> None:
    """Wait until standard input closes, as it does when its writer ends in whichever way."""
    while os.read(sys.stdin.fileno(), 64):
        pass
    with contextlib.suppress(RuntimeError):  # the loop may have ended by itself meanwhile
        loop.call_soon_threadsafe(stop.set)
