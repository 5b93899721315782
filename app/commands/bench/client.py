"""One robot of the load: it sends the frames that it is told to, and notes what comes."""

import asyncio
import time
from collections.abc import Sequence
from contextlib import suppress

import msgspec

from app.commands.bench.accounts import Accounts, StreamLog
from app.commands.bench.link import WAIT_S, Link, open_link
from app.commands.bench.wire import Answer, Heard, LeanWire
from app.commands.client.errors import ClientError, ClosedError, SilenceError
from app.commands.client.messages import Bye, Error, Hello, Ping, VersionChanged, Waiting


class BenchClient:
    """One stream of the load.

    Attributes:
        is_there: whether it sends what it is told to.
        log: what became of its frames.
        accounts: the frames that are on their way.
        failed: done when the stream has ended though it should not have; its result says why.

    Args:
        url: of the service.
        user: whose stream.
        key: API key.
        subprotocol: of the stream.
        frames: the poses, prepared by `LeanWire`; they are shown again and again.
        receive_bytes: what the system holds for it unread; None: what it likes.
    """

    def __init__(
        self,
        url: str,
        user: str,
        *,
        key: str,
        subprotocol: str,
        frames: Sequence[bytes],
        receive_bytes: int | None = None,
    ) -> None:
        loop = asyncio.get_running_loop()
        self.is_there = False
        self.log = StreamLog()
        self.accounts = Accounts(self.log)
        self.failed: asyncio.Future[ClientError] = loop.create_future()
        self._url, self._user, self._key, self._subprotocol = url, user, key, subprotocol
        self._receive_bytes = receive_bytes
        self._frames, self._wire = frames, LeanWire(subprotocol)
        self._link: Link | None = None
        self._greeted: asyncio.Future[None] = loop.create_future()
        self._error: Error | None = None
        self._bye: Bye | None = None

    async def open(self) -> None:
        """Open the stream and wait for its hello.

        Raises:
            ClientError: the service cannot be reached, refuses, or says nothing.
        """
        self._greeted = asyncio.get_running_loop().create_future()
        self._link = link = await open_link(
            self._url,
            self._user,
            self._hear,
            key=self._key,
            subprotocol=self._subprotocol,
            receive_bytes=self._receive_bytes,
        )
        link.ended.add_done_callback(self._fail)
        ends = (self._greeted, link.ended)
        await asyncio.wait(ends, timeout=WAIT_S, return_when=asyncio.FIRST_COMPLETED)
        if link.ended.done():
            raise self._explain(link.ended.result())
        if not self._greeted.done():
            raise SilenceError(f"The server said nothing for {WAIT_S:g} s.")
        self.is_there = True

    def leave(self) -> None:
        """Send nothing more, and wait for no answers; until `open`."""
        self.is_there = False
        self.accounts.leave()

    def pause(self) -> None:
        """Read nothing until `resume`."""
        if self._link is not None:
            self._link.pause()

    def resume(self) -> None:
        """Read again."""
        if self._link is not None:
            self._link.resume()

    async def close(self) -> None:
        """Hang up."""
        self.is_there = False
        link, self._link = self._link, None
        if link is not None:
            link.ended.remove_done_callback(self._fail)
            with suppress(OSError):
                await link.close()

    def send(self, seq: int, due: float, now: float) -> None:
        """Send a frame that was due at an instant; one who is away sends none."""
        if self.is_there and self._link is not None:
            self.accounts.note_sent(seq, due, now)
            pose = self._frames[seq % len(self._frames)]
            self._link.send(self._wire.encode_frame(seq, due, pose))

    def _hear(self, payload: memoryview | bytes) -> None:
        now = time.monotonic()
        try:
            heard = self._wire.decode(payload)
        except msgspec.DecodeError as error:
            self._fail_with(ClosedError(1007, code="bad_message", message=str(error)))
            return
        if type(heard) is Answer:
            self.accounts.note_answer(heard, now)
        else:
            self._note(heard, now)

    def _note(self, heard: Heard | None, now: float) -> None:
        """Take whatever is no forecast."""
        match heard:
            case Waiting():
                self.accounts.note_waiting(heard.seq)
            case Ping():
                if self._link is not None:
                    self._link.send(self._wire.encode_pong(heard, now))
            case Error():
                self._error = heard
                if heard.seq is not None:
                    self.accounts.note_refused(heard.seq, heard.code, now)
            case VersionChanged():
                self.log.swaps += 1
            case Bye():
                self._bye = heard
            case Hello() if not self._greeted.done():
                self._greeted.set_result(None)

    def _fail(self, ended: "asyncio.Future[ClosedError]") -> None:
        self._fail_with(self._explain(ended.result()))

    def _fail_with(self, error: ClientError) -> None:
        if not self.failed.done():
            self.failed.set_result(error)

    def _explain(self, closed: ClosedError) -> ClosedError:
        """Say why a stream ended, in the service's words where it gave any."""
        bye, error = self._bye, self._error
        if bye is None:
            return closed
        told = error.message if error is not None and error.code == bye.reason else bye.reason
        return ClosedError(closed.close_code, code=bye.reason, message=told)
