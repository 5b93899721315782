"""`kinecast serve`: the service, from an empty folder to the first forecast."""

import asyncio
import gc
import hashlib
import shlex
import shutil
import socket
import sys
from pathlib import Path
from typing import Annotated, NamedTuple

import typer

from app.commands.output import fail, out
from app.domain.access import OneTimeCode
from app.settings import Settings, load_settings

SWITCH_S = 1e-3
"""Longest wait of the engine for Python's lock while sockets are read: the default is 5 ms, as long
as dozens of forecasts take."""


def serve(
    host: Annotated[
        str | None, typer.Option(help="Address to listen on.", show_default="127.0.0.1")
    ] = None,
    port: Annotated[
        int | None, typer.Option(help="Port; 0 takes a free one.", show_default="8000")
    ] = None,
    data_dir: Annotated[
        Path | None, typer.Option(help="Folder of the SQLite database.", show_default="var")
    ] = None,
    *,
    no_worker: Annotated[
        bool, typer.Option("--no-worker", help="Start no fine-tuning worker of its own.")
    ] = False,
) -> None:
    """Serve forecasts over HTTP and WebSocket; migrates the database first."""
    settings = load_settings(host=host, port=port, data_dir=data_dir)
    with _listen(settings) as listener:  # before anything slow happens
        _run(settings, listener, with_worker=not no_worker)


def _run(settings: Settings, listener: socket.socket, *, with_worker: bool) -> None:
    from app.logs import configure_logs  # noqa: PLC0415 - slow to import
    from app.main import create_app  # noqa: PLC0415
    from app.server import make_server  # noqa: PLC0415
    from app.worker.embedded import EmbeddedWorker  # noqa: PLC0415

    configure_logs(settings)
    key = asyncio.run(_prepare(settings))
    address = _name_address(listener)
    worker = EmbeddedWorker(settings.data_dir) if with_worker else None
    application = create_app(settings, worker=worker)
    application.state.viewer_code = key.code
    asyncio.run(_register_base(settings))  # now that it could be loaded
    server = make_server(application, settings, on_ready=lambda: _get_going(address, key))
    server.run(sockets=[listener])
    if not server.started:
        fail("The service did not start; the log above says why.", status=1)


def _listen(settings: Settings) -> socket.socket:
    """Take the port, or say in one line why not."""
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    try:
        return socket.create_server((settings.host, settings.port), family=family, backlog=2048)
    except OSError as error:
        reason = error.strerror or str(error)
        fail(f"Cannot listen on {settings.host}:{settings.port}: {reason}.", status=2)


def _name_address(listener: socket.socket) -> str:
    """Give the address that a browser on this machine can open."""
    host, port = listener.getsockname()[:2]
    shown = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)  # noqa: S104 - read, not bound
    return f"http://[{shown}]:{port}" if ":" in shown else f"http://{shown}:{port}"


class _Key(NamedTuple):
    """Where the admin key is, and what a shell on this machine puts before a command to use it."""

    where: str
    prefix: str
    code: OneTimeCode | None = None


async def _prepare(settings: Settings) -> _Key:
    """Bring the database up to date and see to an admin key; tells where that key is."""
    from app.storage.bootstrap import (  # noqa: PLC0415 - slow to import
        ADMIN_KEY_FILE,
        ensure_admin,
        load_audit_key,
    )
    from app.storage.database import Database  # noqa: PLC0415
    from app.storage.migrate import upgrade  # noqa: PLC0415

    database = Database.from_settings(settings)
    try:
        await upgrade(database)
        shown = sys.stdout.isatty()
        keep_in = None if shown else settings.data_dir / ADMIN_KEY_FILE
        made = await ensure_admin(database, settings, keep_in=keep_in)
        load_audit_key(settings)  # made here, where what goes wrong is one line
    except OSError as error:
        fail(f"Cannot keep a secret in {settings.data_dir}: {error.strerror or error}.", status=1)
    finally:
        await database.close()
    return _show_key(settings, made)


async def _register_base(settings: Settings) -> None:
    """Keep the base in the database, and have versions that run on another one fitted again."""
    from app.storage.database import Database  # noqa: PLC0415 - slow to import
    from app.worker.setup import ask_for_refits, read_base, store_base  # noqa: PLC0415

    database = Database.from_settings(settings)
    try:
        base = read_base(settings)
        await store_base(database, base)
        await ask_for_refits(database, hashlib.sha256(base).hexdigest())
    finally:
        await database.close()


def _show_key(settings: Settings, made: str | None) -> _Key:
    """Show a new admin key on a terminal; elsewhere, where output is kept, name its file."""
    from app.storage.bootstrap import ADMIN_KEY_FILE  # noqa: PLC0415 - slow to import

    path = settings.data_dir / ADMIN_KEY_FILE
    if made is not None and sys.stdout.isatty():
        where = f"{made}  (shown only now; keep it)"
        return _Key(where, f"KINECAST_KEY={made} ", OneTimeCode(made))
    if settings.admin_key is not None:
        return _Key("the one in KINECAST_ADMIN_KEY", "KINECAST_KEY=$KINECAST_ADMIN_KEY ")
    if path.is_file() and path.stat().st_size:
        return _Key(f"in {path}", f"KINECAST_KEY=$(cat {shlex.quote(str(path))}) ")
    return _Key("shown at the first start", "KINECAST_KEY=kc_... ")


def _get_going(address: str, key: _Key) -> None:
    """Greet, and spare forecasts the long pauses of a collector that looks at everything.

    Nets and libraries stay for as long as the process does; looking through them takes longer than
    a forecast may.
    """
    gc.collect()
    gc.freeze()
    sys.setswitchinterval(SWITCH_S)
    _greet(address, key)


def _greet(address: str, key: _Key) -> None:
    """Say where to go next, in commands that work as they stand."""
    command = "kinecast" if shutil.which("kinecast") else shlex.quote(sys.argv[0])
    out.print(f"Kinecast is ready at {address}", style="bold", markup=False)
    out.print(f"  Admin key  {key.where}", markup=False)
    code = f"#code={key.code.code}" if key.code else ""
    out.print(f"  Viewer     {address}/{code}", markup=False, soft_wrap=True)
    out.print(f"  API        {address}/docs", markup=False)
    out.print(f"  Try it     {key.prefix}{command} demo --url {address}", markup=False)
    out.print("  Stop       Ctrl+C", markup=False)
