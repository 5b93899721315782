"""The ways of serving that are compared: each is started, asked, checked and stopped."""

import asyncio
import os
import secrets
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from contextlib import (
    AbstractAsyncContextManager,
    AsyncExitStack,
    asynccontextmanager,
    contextmanager,
    suppress,
)
from dataclasses import dataclass
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np

from app.commands.bench.residents import find_settings, give_versions
from app.commands.client.rest import Api
from app.commands.own_server import OwnServer, run_own_server
from app.settings import make_environment
from benchmarks.faults.cluster import find_free_port
from benchmarks.peers.clients import (
    PATIENCE_S,
    Form,
    HttpClient,
    PeerError,
    make_kinecast_form,
    make_litserve_form,
    make_ray_form,
    open_http,
    open_streaming,
)
from benchmarks.peers.load import Ask
from benchmarks.peers.people import Person, Poses, forecast

START_S = 300.0
STOP_S = 30.0
POLL_S = 0.5
TOLERANCE_M = 1e-4
"""Between an answer and the same forecast by PyTorch; two people's differ by centimetres."""
ROOM: dict[str, Any] = {
    "max_rate_hz": 1e4,
    "max_age_ms": 1e7,
    "idle_s": 600.0,
    "log_level": "warning",
}
"""Of Kinecast: a closed loop keeps no sensor's time, and machines pause."""
QUIET = {"OMP_NUM_THREADS": "1", "RAY_USAGE_STATS_ENABLED": "0"}
TAIL_BYTES = 1000


@dataclass(frozen=True, slots=True)
class Crowd:
    """Who asks.

    Attributes:
        people: each with a client of their own.
        folder: of their decoders.
    """

    people: Sequence[Person]
    folder: Path


@dataclass(frozen=True, slots=True)
class Served:
    """People who are served.

    Attributes:
        clients: of each of them; their first answers were checked.
        process: that serves them.
    """

    clients: Sequence[Ask]
    process: int


Open = Callable[[Crowd], AbstractAsyncContextManager[Served]]


@dataclass(frozen=True, slots=True)
class Row:
    """One way of serving.

    Attributes:
        name: in the table.
        package: what it needs beyond Kinecast, None for nothing.
        open: serves people.
    """

    name: str
    package: str | None
    open: Open


@asynccontextmanager
async def open_eager(crowd: Crowd) -> AsyncIterator[Served]:
    """Forecast in this process by PyTorch, one person after the other."""
    turns = cycle(crowd.people)

    async def ask() -> Poses:
        person = next(turns)
        return forecast(person.decoder, [person.window])[0]

    yield Served([ask], os.getpid())


@asynccontextmanager
async def open_peer(
    crowd: Crowd, *, module: str, form: Form, options: Sequence[str] = (), own: bool = True
) -> AsyncIterator[Served]:
    """Run a peer's server and connect everybody to it.

    Args:
        crowd: who asks.
        module: of the server.
        form: how it is asked.
        options: of the server.
        own: everybody has their own decoder; else the base answers all.
    """
    port = find_free_port()
    command = ["--folder", crowd.folder, "--port", port, "--users", len(crowd.people), *options]
    url = f"http://127.0.0.1:{port}"
    with run_process(module, *map(str, command)) as server:
        await _await_answer(server, url, crowd.people[0], form)
        async with _connect(crowd, url, form, own=own) as clients:
            yield Served(clients, server.pid)


@asynccontextmanager
async def open_rest(crowd: Crowd) -> AsyncIterator[Served]:
    """Run Kinecast and ask it by requests, as the peers are asked."""
    async with run_kinecast(crowd) as server:
        form = make_kinecast_form(server.key)
        async with _connect(crowd, server.url, form, own=True) as clients:
            yield Served(clients, server.process.pid)


@asynccontextmanager
async def open_streams(crowd: Crowd) -> AsyncIterator[Served]:
    """Run Kinecast and open everybody's stream."""
    async with run_kinecast(crowd) as server, AsyncExitStack() as stack:
        clients = []
        for person in crowd.people:
            opened = open_streaming(server.url, person, key=server.key)
            client = await stack.enter_async_context(opened)
            check(await client.show_window(), person.expected)
            clients.append(client.ask)
        yield Served(clients, server.process.pid)


@asynccontextmanager
async def run_kinecast(crowd: Crowd) -> AsyncIterator[OwnServer]:
    """Run a service in which everybody has an active version with the weights of their decoder."""
    users = [person.user for person in crowd.people]
    room = {**ROOM, "streams_per_key": max(64, len(users))}
    with (
        tempfile.TemporaryDirectory(prefix="kinecast-peers-") as folder,
        run_own_server(Path(folder), start_s=START_S, **room) as server,
    ):
        async with Api(server.url, key=server.key) as api:
            for user in users:
                await api.add_user(user)
        await asyncio.to_thread(give_versions, find_settings(Path(folder)), users)
        yield server


@asynccontextmanager
async def _connect(
    crowd: Crowd, url: str, form: Form, *, own: bool
) -> AsyncIterator[Sequence[Ask]]:
    """Connect everybody, and check their first and their last answers."""
    async with AsyncExitStack() as stack:
        clients = [
            await stack.enter_async_context(open_http(url, person, form)) for person in crowd.people
        ]
        await _check_all(crowd, clients, own=own)
        yield [client.ask for client in clients]
        await _check_all(crowd, clients, own=own)


async def _check_all(crowd: Crowd, clients: Sequence[HttpClient], *, own: bool) -> None:
    """Ask once for everybody, and hold the answers against PyTorch's."""
    async with asyncio.timeout(PATIENCE_S):
        for client, person in zip(clients, crowd.people, strict=True):
            check(await client.ask(), person.expected if own else person.expected_of_base)


def check(answer: Poses, expected: Poses) -> None:
    """Compare an answer with what PyTorch makes of the same window and weights.

    Raises:
        PeerError: they differ.
    """
    if answer.shape != expected.shape:
        raise PeerError(f"a forecast of {answer.shape} instead of {expected.shape}")
    apart = float(np.abs(answer - expected).max())
    if not apart <= TOLERANCE_M:
        raise PeerError(f"a forecast that is {apart * 1e3:.1f} mm off")


async def _await_answer(
    server: "subprocess.Popen[bytes]", url: str, person: Person, form: Form
) -> None:
    """Ask until a server that was just started answers."""
    deadline, last = time.monotonic() + START_S, ""
    while time.monotonic() < deadline and server.poll() is None:
        try:
            async with asyncio.timeout(PATIENCE_S), open_http(url, person, form) as client:
                await client.ask()
        except (OSError, EOFError, PeerError) as error:
            last = str(error)
            await asyncio.sleep(POLL_S)
        else:
            return
    raise PeerError(f"the server does not start: {last}")


@contextmanager
def run_process(module: str, *options: str) -> Iterator["subprocess.Popen[bytes]"]:
    """Run a module until the block ends; what it has started ends with it.

    Raises:
        PeerError: what went wrong in the block, with the end of the module's log.
    """
    environment = make_environment() | QUIET | {"RAY_AUTH_TOKEN": secrets.token_hex(32)}
    with tempfile.TemporaryFile() as log:
        process = subprocess.Popen(
            [sys.executable, "-m", module, *options],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            env=environment,
            start_new_session=True,
        )
        try:
            yield process
        except (OSError, EOFError, PeerError) as error:
            log.seek(0)
            tail = log.read()[-TAIL_BYTES:].decode(errors="replace").strip()
            raise PeerError(f"{error}; the end of its log: {tail}") from error
        finally:
            _stop(process)


def _stop(process: "subprocess.Popen[bytes]") -> None:
    """Ask a server to stop, and kill what is left of its own group of processes after a while."""
    process.terminate()
    with suppress(subprocess.TimeoutExpired):
        process.wait(STOP_S)
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def list_rows(workers: int) -> list[Row]:
    """Give every way, in the order of the table."""
    litserve = partial(
        open_peer, module="benchmarks.peers.litserve_server", form=make_litserve_form()
    )
    many = ("--workers", str(workers))
    return [
        Row("PyTorch in process, one after the other", None, open_eager),
        Row(
            "Ray Serve, multiplexed by user, HTTP",
            "ray",
            partial(
                open_peer, module="benchmarks.peers.ray_server", form=make_ray_form(), options=many
            ),
        ),
        Row("LitServe, dictionary of decoders, HTTP", "litserve", partial(litserve, options=many)),
        Row(
            "LitServe, one decoder for all, batched, HTTP",
            "litserve",
            partial(litserve, options=["--one"], own=False),
        ),
        Row("Kinecast, REST", None, open_rest),
        Row("Kinecast, stream", None, open_streams),
    ]
