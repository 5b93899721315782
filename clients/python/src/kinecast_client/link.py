"""Carries out what the core decides: dials, reads, writes, waits. On an asyncio loop."""

import asyncio
import logging
import threading
import time
from collections.abc import Callable, Coroutine
from contextlib import suppress
from typing import Any, NamedTuple

from websockets import ConnectionClosed, InvalidStatus, Subprotocol, WebSocketException
from websockets.asyncio.client import ClientConnection, connect

from kinecast_client.address import find_stream_url, is_loopback
from kinecast_client.clock import Moment
from kinecast_client.core import BROKEN, MAX_MESSAGE_BYTES, Core, Phase
from kinecast_client.events import Event

TICK_S = 0.05
CLOSE_S = 1.0
WRITE_BYTES = 4096
"""More than this never waits in our process: so the newest frame wins before it is written."""

log = logging.getLogger("kinecast_client")


class _Dial(connect):
    """Follows no redirect: the key is for the service that was named, and for nobody else."""

    def process_redirect(self, exc: Exception) -> Exception:
        """Take it for what it is, an answer that opens no stream."""
        return exc


class Target(NamedTuple):
    """Where a stream leads.

    Attributes:
        url: of the service, http or https.
        user: whose stream.
        key: the API key.
    """

    url: str
    user: str
    key: str


class Link:
    """Runs one core on the event loop that calls `run`.

    Args:
        core: what to carry out; touched under `lock` only.
        target: where to.
        clock: of the frames, seconds.
        lock: whoever touches the core has it; never held while anything waits.
        tell: called with every event, and without one for each forecast, on the loop's thread.
    """

    def __init__(
        self,
        core: Core,
        target: Target,
        *,
        clock: Callable[[], float],
        lock: threading.Lock,
        tell: Callable[[list[Event]], None],
    ) -> None:
        self.core, self._target, self._clock = core, target, clock
        self._lock, self._tell = lock, tell
        self._loop: asyncio.AbstractEventLoop | None = None
        self._wake = asyncio.Event()
        self._end = asyncio.Event()

    def now(self) -> Moment:
        """Read both clocks."""
        return Moment(time.monotonic(), self._clock())

    def wake(self) -> None:
        """Have what was handed to the core sent; from any thread, at once, never raises."""
        loop = self._loop
        if loop is not None:
            with suppress(RuntimeError):  # the loop is closed: nothing is sent any more
                loop.call_soon_threadsafe(self._wake.set)

    def end(self) -> None:
        """Have `run` come to its end; from any thread, at once, never raises."""
        loop = self._loop
        if loop is not None:
            with suppress(RuntimeError):
                loop.call_soon_threadsafe(self._end.set)

    async def run(self) -> None:
        """Keep the stream up until it is closed or stops for good."""
        self._loop = asyncio.get_running_loop()
        ending = asyncio.ensure_future(self._end.wait())
        try:
            while not self._end.is_set() and not self._is_over():
                await _until(ending, self._attend_safely())
                await _until(ending, self._rest())
        finally:
            ending.cancel()
            with self._lock:
                self.core.close()
            self._tell([])

    def _is_over(self) -> bool:
        with self._lock:
            return self.core.is_over

    async def _rest(self) -> None:
        with self._lock:
            is_resting, until = self.core.phase is Phase.RESTING, self.core.retry_at
        if is_resting:
            await asyncio.sleep(max(0.0, until - time.monotonic()))

    async def _attend_safely(self) -> None:
        """Make one connection; a defect costs that one, and not the robot's forecasts."""
        try:
            await self._attend()
        except Exception as error:
            log.exception("a connection ended by a defect of the client")
            self._report_lost(self.core.connection, BROKEN, f"{type(error).__name__}: {error}")

    async def _attend(self) -> None:
        """Make one connection and serve it to its end."""
        with self._lock:
            number = self.core.dial(self.now())
            query = self.core.query()
            subprotocol = self.core.wire.subprotocol
            open_s = self.core.rules.open_s
        url, user, key = self._target
        try:
            socket = await _Dial(
                find_stream_url(url, user, query),
                subprotocols=[Subprotocol(subprotocol)],
                additional_headers={"Authorization": f"Bearer {key}"},
                compression=None,
                max_size=MAX_MESSAGE_BYTES,
                open_timeout=open_s,
                close_timeout=CLOSE_S,
                ping_interval=None,
                proxy=None if is_loopback(url) else True,
                write_limit=WRITE_BYTES,
            )
        except (OSError, asyncio.TimeoutError, WebSocketException, EOFError) as error:
            self._report_lost(number, BROKEN, _explain(error, url))
            return
        await self._serve(socket, number)

    async def _serve(self, socket: ClientConnection, number: int) -> None:
        with self._lock:
            self.core.connected(number)
        reader = asyncio.ensure_future(self._read(socket, number))
        others = (asyncio.ensure_future(part) for part in (self._write(socket), self._tick()))
        parts = (reader, *others)
        try:
            await asyncio.wait(parts, return_when=asyncio.FIRST_COMPLETED)
            with self._lock:
                is_dead = self.core.hang_up is not None
            if not is_dead:  # the last messages say why the service closes
                await asyncio.wait({reader}, timeout=CLOSE_S)
            for part in parts:
                part.cancel()
            if is_dead:
                socket.transport.abort()
            for outcome in await asyncio.gather(*parts, return_exceptions=True):
                if isinstance(outcome, Exception):
                    raise outcome
            code, reason = (BROKEN, "") if is_dead else await _find_end(socket)
            self._report_lost(number, code, reason or "the connection broke")
        finally:
            for part in parts:
                part.cancel()
            with suppress(ConnectionClosed, OSError, asyncio.TimeoutError):
                await socket.close()

    async def _read(self, socket: ClientConnection, number: int) -> None:
        with suppress(ConnectionClosed):
            while True:
                data = await socket.recv()
                with self._lock:
                    before = self.core.generation
                    events = self.core.received(number, data, self.now())
                    is_news = bool(events) or self.core.generation != before
                    is_end = self.core.hang_up is not None or self.core.phase is Phase.STOPPED
                if is_news:
                    self._tell(events)
                if is_end:
                    return
                self._wake.set()  # it may want to be answered

    async def _write(self, socket: ClientConnection) -> None:
        with suppress(ConnectionClosed):
            while True:
                with self._lock:
                    data = self.core.take(self.now())
                if data is None:
                    await self._wake.wait()
                    self._wake.clear()
                else:
                    await socket.send(data)

    async def _tick(self) -> None:
        while True:
            await asyncio.sleep(TICK_S)
            with self._lock:
                self.core.tick(self.now())
                if self.core.hang_up is not None:
                    return
            self._wake.set()

    def _report_lost(self, number: int, code: int, reason: str) -> None:
        with self._lock:
            events = self.core.lost(number, code, reason, self.now())
        log.info("stream of %s lost: %s (%d)", self._target.user, reason, code)
        self._tell(events)


def _explain(error: Exception, url: str) -> str:
    if isinstance(error, InvalidStatus):
        status = error.response.status_code
        return f"{url} answers with HTTP status {status} and opens no stream; is the address right?"
    return str(error) or type(error).__name__


async def _find_end(socket: ClientConnection) -> tuple[int, str]:
    """Give how the service ended the connection."""
    with suppress(asyncio.TimeoutError):
        await asyncio.wait_for(socket.wait_closed(), CLOSE_S)
    received = socket.protocol.close_rcvd
    return (BROKEN, "") if received is None else (received.code, received.reason)


async def _until(ending: asyncio.Future[Any], work: Coroutine[Any, Any, None]) -> None:
    """Do some work, but no longer than until the end."""
    task = asyncio.ensure_future(work)
    try:
        both: set[asyncio.Future[Any]] = {ending, task}
        await asyncio.wait(both, return_when=asyncio.FIRST_COMPLETED)
    finally:
        if not task.done():
            task.cancel()
            await asyncio.wait({task})
    if not task.cancelled():
        task.result()
