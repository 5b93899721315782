"""A WebSocket that costs next to nothing: what the load generator streams over.

The handshake is the `websockets` library's; frames are read and written here, without tasks,
queues and time limits for each message.
"""

import asyncio
import secrets
import socket
import ssl
import struct
from collections.abc import Callable
from contextlib import suppress
from typing import Any
from urllib.parse import urlsplit

from websockets.client import ClientProtocol
from websockets.protocol import State
from websockets.speedups import apply_mask
from websockets.typing import Subprotocol
from websockets.uri import parse_uri

from app.commands.bench.inbox import FramingError, Inbox, Kind
from app.commands.client.errors import ClosedError, UnreachableError
from app.commands.client.messages import MSGPACK
from app.commands.client.stream import find_stream_url

WAIT_S = 10.0
_END_OF_HEAD = b"\r\n\r\n"
_SHORT, _LONG = struct.Struct(">BB4s"), struct.Struct(">BBH4s")

Listener = Callable[[memoryview | bytes], None]


class Link(asyncio.BufferedProtocol):
    """One connection. Made by `open_link`.

    Attributes:
        ended: done when the connection has ended; its result is why.

    Args:
        handshake: how the connection begins.
        listener: called with every message, whose bytes are valid only during the call.
        is_binary: whether messages are binary.
    """

    def __init__(self, handshake: ClientProtocol, listener: Listener, *, is_binary: bool) -> None:
        loop = asyncio.get_running_loop()
        self.ended: asyncio.Future[ClosedError] = loop.create_future()
        self.opened: asyncio.Future[None] = loop.create_future()
        self._handshake, self._listener = handshake, listener
        self._first = 0x80 | (Kind.BINARY if is_binary else Kind.TEXT)
        self._inbox, self._mask = Inbox(), secrets.token_bytes(4)
        self._transport: asyncio.Transport
        self._is_open = self._is_closing = False

    def send(self, payload: bytes) -> None:
        """Send a message; nothing happens on a connection that has ended."""
        if self._is_open:
            self._write(self._first, payload)

    def pause(self) -> None:
        """Read nothing until `resume`."""
        if self._is_open:
            self._transport.pause_reading()

    def resume(self) -> None:
        """Read again."""
        if self._is_open:
            self._transport.resume_reading()

    async def close(self) -> None:
        """Say goodbye and hang up."""
        if self._is_open and not self._is_closing:
            self._is_closing = True
            self._write(0x80 | Kind.CLOSE, struct.pack(">H", 1000))
            with suppress(TimeoutError):
                await asyncio.wait_for(asyncio.shield(self.ended), WAIT_S)
        self._transport.abort()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Ask for a WebSocket."""
        assert isinstance(transport, asyncio.Transport)  # noqa: S101 - for the type checker
        self._transport = transport
        self._transport.writelines(self._handshake.data_to_send())

    def get_buffer(self, sizehint: int) -> memoryview:
        """Give the room for what arrives next."""
        del sizehint
        return self._inbox.room()

    def buffer_updated(self, nbytes: int) -> None:
        """Hand over every message that is complete."""
        self._inbox.add(nbytes)
        try:
            if not self._is_open and not self._shake_hands():
                return
            while (message := self._inbox.take_message()) is not None:
                kind, payload = message
                if kind < Kind.CLOSE:
                    self._listener(payload)
                else:
                    self._control(kind, bytes(payload))
        except FramingError as error:
            self._end(1002, f"The server sent {error}.")
            self._transport.abort()

    def eof_received(self) -> None:
        """Take the end of the connection, which closes it."""

    def connection_lost(self, exc: Exception | None) -> None:
        """Note the end."""
        self._end(1006, f"The connection broke{f': {exc}' if exc else ''}.")

    def _shake_hands(self) -> bool:
        """Read the answer to the handshake; tells whether it is complete and good."""
        head = self._inbox.find_line(_END_OF_HEAD)
        if head is None:
            return False
        self._handshake.receive_data(head)
        if self._handshake.state is not State.OPEN:
            line = head.partition(b"\r\n")[0].decode(errors="replace")
            self._end(1006, str(self._handshake.handshake_exc or f"The server answered {line}"))
            return False
        self._is_open = True
        self.opened.set_result(None)
        return True

    def _control(self, kind: int, payload: bytes) -> None:
        if kind == Kind.PING:
            self._write(0x80 | Kind.PONG, payload)
        elif kind == Kind.CLOSE:
            code = int.from_bytes(payload[:2], "big") if len(payload) >= 2 else 1005
            if not self._is_closing:
                self._is_closing = True
                self._write(0x80 | Kind.CLOSE, payload[:2])
            self._end(code, payload[2:].decode(errors="replace") or "The server closed it.")

    def _write(self, first: int, payload: bytes) -> None:
        size, mask = len(payload), self._mask
        if size < 126:
            head = _SHORT.pack(first, 0x80 | size, mask)
        else:  # a frame of a person is never over 64 KiB
            head = _LONG.pack(first, 0x80 | 126, size, mask)
        self._transport.write(head + apply_mask(payload, mask))

    def _end(self, code: int, why: str) -> None:
        self._is_open = False
        if not self.ended.done():
            self.ended.set_result(ClosedError(code, code="closed", message=why))


async def open_link(
    url: str,
    user: str,
    listener: Listener,
    *,
    key: str,
    subprotocol: str,
    receive_bytes: int | None = None,
) -> Link:
    """Open a user's stream, directly and never through a proxy.

    Args:
        url: of the service.
        user: whose stream.
        listener: called with every message; see `Link`.
        key: API key.
        subprotocol: of the stream.
        receive_bytes: what the system may hold for us unread; None: what it likes.

    Raises:
        UnreachableError: there is no stream.
    """
    address = parse_uri(find_stream_url(url, user))
    handshake = ClientProtocol(address, subprotocols=[Subprotocol(subprotocol)])
    request = handshake.connect()
    request.headers["Authorization"] = f"Bearer {key}"
    handshake.send_request(request)
    is_binary = subprotocol == MSGPACK
    loop = asyncio.get_running_loop()
    try:
        async with asyncio.timeout(WAIT_S):
            connected = await _connect(address.host, address.port, receive_bytes)
            _, link = await loop.create_connection(
                lambda: Link(handshake, listener, is_binary=is_binary),
                sock=connected,
                ssl=ssl.create_default_context() if address.secure else None,
                server_hostname=urlsplit(url).hostname if address.secure else None,
            )
            ends: set[asyncio.Future[Any]] = {link.opened, link.ended}
            await asyncio.wait(ends, return_when=asyncio.FIRST_COMPLETED)
    except (OSError, TimeoutError) as error:
        raise UnreachableError(f"No stream at {url}: {error or type(error).__name__}.") from error
    if not link.opened.done():
        await link.close()
        raise UnreachableError(f"No stream at {url}: {link.ended.result()}")
    return link


async def _connect(host: str, port: int, receive_bytes: int | None) -> socket.socket:
    """Connect; what the system holds unread has to be limited before."""
    loop = asyncio.get_running_loop()
    problem: OSError = OSError("no address")
    for family, kind, protocol, _, where in await loop.getaddrinfo(
        host, port, type=socket.SOCK_STREAM
    ):
        connected = socket.socket(family, kind, protocol)
        try:
            connected.setblocking(False)  # noqa: FBT003 - the name of what is set
            connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            if receive_bytes is not None:
                connected.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_bytes)
            await loop.sock_connect(connected, where)
        except OSError as error:
            connected.close()
            problem = error
        else:
            return connected
    raise problem
