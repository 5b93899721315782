"""A stream as a client sees it: frames out, messages in, and a deadline on every wait."""

import asyncio
import ipaddress
import time
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager, suppress
from urllib.parse import quote, urlencode, urlsplit

import numpy as np
from jaxtyping import Float
from websockets import ConnectionClosed, InvalidURI, Subprotocol, WebSocketException
from websockets.asyncio.client import ClientConnection, connect

from app.commands.client.errors import ClosedError, SilenceError, UnreachableError
from app.commands.client.messages import (
    MSGPACK,
    Bye,
    Error,
    Hello,
    Message,
    Ping,
    Pong,
    Wire,
)

WAIT_S = 5.0
MAX_MESSAGE_BYTES = 4 * 2**20
_RTT_FORGET = 1.02
"""A round trip counts as better than the best one so far if it is at most this much longer for
each one since: clocks drift."""


class _Dial(connect):
    """Follows no redirect: the key is for the service that was named, and for nobody else."""

    def process_redirect(self, exc: Exception) -> Exception:
        """Take it for what it is, an answer that opens no stream."""
        return exc


class Stream:
    """An open stream. Made by `open_stream`.

    Attributes:
        hello: what the server said first.
        offset_s: the server's clock minus ours, None before the first pong.
        rtt_s: the round trip by which the offset was measured.
    """

    def __init__(
        self, socket: ClientConnection, wire: Wire, *, clock: Callable[[], float], wait_s: float
    ) -> None:
        self.hello: Hello
        self.offset_s: float | None = None
        self.rtt_s = float("inf")
        self._socket, self._wire, self._clock, self._wait_s = socket, wire, clock, wait_s
        self._pings = 0
        self._last_error: Error | None = None
        self._bye: Bye | None = None

    async def send_frame(
        self,
        seq: int,
        t: float,
        joints: Float[np.ndarray, "joint 3"] | None,
        confidence: Float[np.ndarray, " joint"] | None = None,
        *,
        replay: bool = False,
    ) -> None:
        """Send a frame.

        Args:
            seq: above that of the frame before.
            t: capture time on our clock, seconds.
            joints: metres; NaN for a missing joint, None for a frame without the person.
            confidence: 0 … 1 per joint.
            replay: sent again after a reconnect.

        Raises:
            ClosedError: the stream ended.
            SilenceError: the server takes nothing.
        """
        extra = {"replay": True} if replay else {}
        await self.send_raw(self._wire.encode_frame(seq, t, joints, confidence, **extra))

    async def send(self, kind: str, **fields: object) -> None:
        """Send another message, such as `configure` or `reset`; raises as `send_frame` does."""
        await self.send_raw(self._wire.encode(kind, **fields))

    async def send_raw(self, data: str | bytes) -> None:
        """Send bytes or text as they are; raises as `send_frame` does."""
        try:
            async with asyncio.timeout(self._wait_s):
                await self._socket.send(data)
        except TimeoutError:
            raise SilenceError(f"The server took nothing for {self._wait_s:g} s.") from None
        except ConnectionClosed as closed:
            raise self._explain(closed) from None

    async def ping(self) -> None:
        """Measure the clock offset; it is there once the pong has been received."""
        self._pings += 1
        await self.send("ping", id=self._pings, t=self._clock())

    async def receive(self, *, timeout_s: float | None = None) -> Message:
        """Wait for the next message; pings of the server are answered on the way.

        Raises:
            ClosedError: the stream ended.
            SilenceError: nothing came in time.
            ValueError: what came cannot be read.
        """
        wait_s = self._wait_s if timeout_s is None else timeout_s
        try:
            async with asyncio.timeout(wait_s):
                data = await self._socket.recv()
        except TimeoutError:
            raise SilenceError(f"The server said nothing for {wait_s:g} s.") from None
        except ConnectionClosed as closed:
            raise self._explain(closed) from None
        message = self._wire.decode(data)
        await self._note(message)
        return message

    async def messages(self, *, silence_s: float | None = None) -> AsyncIterator[Message]:
        """Yield every message until the stream ends, which raises; see `receive`."""
        while True:
            yield await self.receive(timeout_s=silence_s)

    async def _note(self, message: Message) -> None:
        match message:
            case Ping():
                await self.send("pong", id=message.id, server_t=message.server_t, t=self._clock())
            case Pong():
                self._learn(message)
            case Error():
                self._last_error = message
            case Bye():
                self._bye = message

    def _learn(self, pong: Pong) -> None:
        now = self._clock()
        rtt_s = now - pong.t
        self.rtt_s *= _RTT_FORGET
        if 0 <= rtt_s <= self.rtt_s:
            self.rtt_s = rtt_s
            self.offset_s = pong.server_t - (pong.t + now) / 2

    def _explain(self, closed: ConnectionClosed) -> ClosedError:
        if closed.rcvd is None:
            return ClosedError(1006, code="connection_lost", message="The connection broke.")
        bye, error = self._bye, self._last_error
        if bye is not None:  # the error before the goodbye is the reason; older ones were forgiven
            told = error.message if error is not None and error.code == bye.reason else bye.reason
            return ClosedError(
                closed.rcvd.code,
                code=bye.reason,
                message=told,
                retry_after_s=bye.retry_after_s,
            )
        reason = closed.rcvd.reason or "closed"
        return ClosedError(closed.rcvd.code, code=reason, message="The server closed the stream.")


@asynccontextmanager
async def open_stream(
    url: str,
    user: str,
    *,
    key: str | None,
    subprotocol: str = MSGPACK,
    query: Mapping[str, str | int | float] | None = None,
    clock: Callable[[], float] = time.monotonic,
    wait_s: float = WAIT_S,
) -> AsyncIterator[Stream]:
    """Open a stream and wait for its hello.

    Args:
        url: of the service, http or ws.
        user: whose stream.
        key: goes into the header; None sends none.
        subprotocol: `JSON` or `MSGPACK`.
        query: parameters of the URL, such as `forecast_every`.
        clock: seconds, the clock of the frames' `t`.
        wait_s: longest wait for anything.

    Raises:
        UnreachableError: nobody answers there.
        ClosedError: the server refuses.
        SilenceError: the server says nothing.
    """
    address = find_stream_url(url, user, query)
    headers = {} if key is None else {"Authorization": f"Bearer {key}"}
    connection = _Dial(
        address,
        subprotocols=[Subprotocol(subprotocol)],
        additional_headers=headers,
        compression=None,
        max_size=MAX_MESSAGE_BYTES,
        open_timeout=wait_s,
        close_timeout=wait_s,
        ping_interval=None,
        proxy=None if is_loopback(url) else True,
    )
    try:
        socket = await connection
    except (OSError, TimeoutError, WebSocketException, InvalidURI) as error:
        raise UnreachableError(f"No stream at {url}: {error or type(error).__name__}.") from error
    try:
        stream = Stream(socket, Wire(subprotocol), clock=clock, wait_s=wait_s)
        stream.hello = await _await_hello(stream)
        yield stream
    finally:
        with suppress(ConnectionClosed, OSError):
            await socket.close()


def find_stream_url(
    url: str, user: str, query: Mapping[str, str | int | float] | None = None
) -> str:
    """Give the WebSocket address of a user's stream."""
    base = url.rstrip("/")
    for scheme, streaming in (("http://", "ws://"), ("https://", "wss://")):
        if base.startswith(scheme):
            base = streaming + base.removeprefix(scheme)
    return f"{base}/v1/users/{quote(user, safe='')}/stream" + (
        f"?{urlencode(query)}" if query else ""
    )


def is_loopback(url: str) -> bool:
    """Whether an address is on this machine, where no proxy can know it."""
    host = urlsplit(url).hostname or ""
    with suppress(ValueError):
        return ipaddress.ip_address(host).is_loopback
    return host == "localhost"


async def _await_hello(stream: Stream) -> Hello:
    """Wait for the hello; a refusal says why and closes."""
    while True:
        message = await stream.receive()
        if isinstance(message, Hello):
            return message
