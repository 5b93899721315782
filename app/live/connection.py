"""One open stream: a task that reads, a task that writes, and the engine between them."""

import asyncio
import time
from collections.abc import Awaitable, Callable, Iterable
from typing import Protocol, runtime_checkable

import structlog
from msgspec import UNSET

from app.domain.errors import DrainingError, KinecastError, NotReadyError, VersionUnavailableError
from app.domain.streams import JobNews, OpenStream
from app.domain.users import Lived
from app.live.actions import Action, Send, Store, Submit, Ticket, describe
from app.live.codec import Codec
from app.live.engine import Engine
from app.live.outbox import Outbox
from app.live.protocol import Configure, JobMessage, ServerMessage
from app.live.scribe import Scribe
from app.live.session import Session
from app.live.steps import Archive, Outcome
from app.live.work import Choice, EngineResult

STALL_S = 5.0
"""A client that takes nothing for this long is given up."""
LEAVE_S = 2.0
"""Longest wait for the last messages to leave."""
READ_OUT_S = 1.0
"""Longest wait for what a client sent before it left to be read: it may have stopped a trial."""
SETTLE_S = 4.0
"""Longest wait for the last frames of a recording to be stored."""
AGAIN_S = 0.3
"""Where that fails meanwhile, it is tried again after this long."""

Fetch = Callable[[int], Awaitable[Choice]]
"""Loads a pinned version of the user; raises VersionUnavailableError where it cannot be used."""

Take = Callable[[str | bytes], bool]
"""Takes a message at once, or tells that it cannot be taken just now."""

log = structlog.get_logger(__name__)


class GoneError(Exception):
    """The client is not there any more."""


@runtime_checkable
class Socket(Protocol):
    """What a connection needs of a WebSocket."""

    async def receive(self) -> str | bytes:
        """Wait for a message.

        Raises:
            GoneError: the client closed the connection or vanished.
        """
        ...

    async def send(self, data: bytes) -> None:
        """Send a message; waits as long as the client takes none.

        Raises:
            GoneError: the client is gone.
        """
        ...

    async def refuse(self, error: KinecastError, codec: Codec) -> None:
        """Say why, say goodbye and close with the error's code."""
        ...

    def listen(self, take: Take | None) -> None:
        """Offer each message as it comes, None to nobody; `receive` gives what is not taken."""
        ...

    @property
    def is_clear(self) -> bool:
        """Whether `send_now` can send: the client is there and takes what is sent."""
        ...

    def send_now(self, data: bytes) -> None:
        """Send a message without waiting, while `is_clear`."""
        ...


class Connection:
    """One open stream, from its hello to its end.

    Args:
        socket: the accepted WebSocket.
        codec: the subprotocol.
        session: what it does with messages.
        engine: where forecasts are made.
        stream: what the database knows it by.
        archive: carries out the steps of a recording.
        fetch: loads pinned versions, None where there are none.
    """

    def __init__(
        self,
        socket: Socket,
        codec: Codec,
        session: Session,
        engine: Engine,
        stream: OpenStream,
        *,
        archive: Archive,
        fetch: Fetch | None = None,
    ) -> None:
        self._fetch = fetch
        self.stream = stream
        self.closed = asyncio.Event()
        self._socket, self._codec, self._session = socket, codec, session
        self._slot = engine.open_slot(asyncio.get_running_loop())
        self._outbox = Outbox()
        self._scribe = Scribe(archive, self._note)
        self._sending_since: float | None = None
        self._writer: asyncio.Task[None] | None = None
        self._is_busy = self._is_over = False
        self._broken: asyncio.Future[None] = asyncio.get_running_loop().create_future()

    async def run(self) -> None:
        """Serve the client until one side ends it; then store what was recorded."""
        self._outbox.put(self._session.hello())
        self._writer = asyncio.create_task(self._write())
        reader = asyncio.create_task(self._read())
        scribe = asyncio.create_task(self._scribe.run())
        tasks = (self._writer, reader, scribe)
        self._socket.listen(self._take)
        try:
            await asyncio.wait((*tasks, self._broken), return_when=asyncio.FIRST_COMPLETED)
            if self._outbox.ending is not None:
                await asyncio.wait({self._writer}, timeout=LEAVE_S)
            elif self._writer.done() and not self._writer.cancelled():
                await asyncio.wait({reader}, timeout=READ_OUT_S)
        finally:
            self._is_over = True
            self._socket.listen(None)
            self._slot.close()
            self._writer.cancel()
            reader.cancel()
            await asyncio.wait({self._writer, reader})
            await self._settle(scribe)
            self._broken.cancel()
            outcomes = await asyncio.gather(*tasks, self._broken, return_exceptions=True)
            self.closed.set()
        for outcome in outcomes:
            if isinstance(outcome, Exception) and not isinstance(outcome, GoneError):
                raise outcome

    def end(self, error: KinecastError) -> None:
        """Tell the client why, and close."""
        self._outbox.end(error)

    def set_unconfirmed(self, *, unconfirmed: bool) -> None:
        """Flag forecasts while nobody can tell whether their weights are still the right ones."""
        self._session.weights.unconfirmed = unconfirmed

    def switch(self, choice: Choice) -> None:
        """Let other weights answer from the next forecast on."""
        self._perform(self._session.switch(choice))

    def tell_job(self, news: JobNews) -> None:
        """Tell the client how a job of its user stands."""
        metrics = UNSET if news.metrics is None else news.metrics
        self._outbox.put(JobMessage(news.id, news.state, news.progress, metrics))

    def take_lived(self) -> Lived | None:
        """Give whose body was seen since the last time, None if not for long enough."""
        return self._session.sightings.take()

    def tick(self, now: float) -> None:
        """Do what is due with the time: about once a second."""
        if self._sending_since is not None and now - self._sending_since > STALL_S:
            log.info("a client takes nothing; its stream is given up")
            if self._writer is not None:
                self._writer.cancel()
            return
        self._perform(self._session.tick(now))

    async def _read(self) -> None:
        """Drain the socket into the session; the newest window waits in the engine's slot."""
        while self._outbox.ending is None:
            data = await self._socket.receive()
            self._is_busy = True
            message = self._codec.decode(data)
            if not isinstance(message, Configure) or await self._prepare(message):
                self._perform(self._session.receive(message, time.monotonic()))
                if not self._outbox.has_room:
                    await self._outbox.wait_for_room()
            self._is_busy = False
            await asyncio.sleep(0)  # a burst is read without waiting: let the others have a turn

    def _take(self, data: str | bytes) -> bool:
        """Read a message as it comes in, without a task's turn; tells whether that was possible."""
        is_ending = self._is_over or self._outbox.ending is not None
        if is_ending or self._is_busy or not self._outbox.has_room:
            return False
        try:
            message = self._codec.decode(data)
            if isinstance(message, Configure):  # may have to wait for the database
                return False
            self._perform(self._session.receive(message, time.monotonic()))
        except Exception as error:  # noqa: BLE001 - `run` raises it, as it does those of its tasks
            self._break(error)
        return True

    def _break(self, error: Exception) -> None:
        self._is_over = True
        if not self._broken.done():
            self._broken.set_exception(error)

    async def _prepare(self, message: Configure) -> bool:
        """Load a version that is about to be pinned; the session refuses what was not loaded.

        Tells whether to go on; without the database the client is told to try again.
        """
        number = message.version
        if self._fetch is not None and isinstance(number, int) and number:
            try:
                self._session.weights.pin(await self._fetch(number))
            except VersionUnavailableError:
                return True
            except NotReadyError as error:
                self._outbox.put(describe(error))
                return False
        return True

    async def _write(self) -> None:
        while True:
            await self._outbox.wait_for_something()
            while (message := self._outbox.take_message()) is not None:
                await self._send(message)
            if self._outbox.ending is not None:
                self._sending_since = time.monotonic()
                await self._socket.refuse(self._outbox.ending, self._codec)
                return
            forecast = self._outbox.take_forecast()
            if forecast is not None:
                await self._send_forecast(*forecast)

    async def _send_forecast(self, ticket: Ticket, result: EngineResult) -> None:
        for action in self._session.answer(ticket, result, time.monotonic()):
            if isinstance(action, Send):
                await self._send(action.message)
            else:
                self._perform([action])

    def _deliver_now(self, ticket: Ticket, result: EngineResult) -> None:
        """Answer without a task's turn: nothing else waits to be sent."""
        try:
            for action in self._session.answer(ticket, result, time.monotonic()):
                if isinstance(action, Send):
                    self._socket.send_now(self._codec.encode(action.message))
                else:
                    self._perform([action])
        except Exception as error:  # noqa: BLE001 - `run` raises it, as it does those of its tasks
            self._break(error)

    async def _send(self, message: ServerMessage) -> None:
        self._sending_since = time.monotonic()
        await self._socket.send(self._codec.encode(message))
        self._sending_since = None

    def _perform(self, actions: Iterable[Action]) -> None:
        for action in actions:
            if isinstance(action, Send):
                self._outbox.put(action.message)
            elif isinstance(action, Submit):
                self._submit(action)
            elif isinstance(action, Store):
                self._scribe.put(action.step)
            else:
                self._outbox.end(action.error)

    def _note(self, outcome: Outcome | KinecastError) -> None:
        """Tell the session what came of a step of the recording."""
        self._perform(self._session.wrote(outcome, time.monotonic()))

    async def _settle(self, scribe: asyncio.Task[None]) -> None:
        """Store what was recorded until now, as far as that is quick.

        A database that is away may be back in a second, so what failed is tried again till then.
        """
        recorder = self._session.recorder
        until = time.monotonic() + SETTLE_S
        while True:
            self._perform(recorder.leave(time.monotonic()))
            await self._scribe.settle(until - time.monotonic(), scribe)
            is_over = scribe.done() or time.monotonic() + AGAIN_S >= until
            if recorder.is_settled or is_over:
                break
            await asyncio.sleep(AGAIN_S)
        scribe.cancel()
        if recorder.waiting:
            log.warning("a stream ended with frames that are not stored", frames=recorder.waiting)

    def _submit(self, action: Submit) -> None:
        ticket = action.ticket

        def deliver(result: EngineResult) -> None:
            if self._is_over:
                return
            if self._sending_since is None and not self._outbox and self._socket.is_clear:
                self._deliver_now(ticket, result)
            else:
                self._outbox.put_forecast(ticket, result)

        if self._is_over:
            return
        try:
            self._slot.put(action.request, deliver)
        except DrainingError as error:
            self._outbox.end(error)
