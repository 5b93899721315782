"""The WebSocket itself: how it closes, and what happens to messages that are no messages."""

import asyncio
import contextlib
from collections.abc import Iterator
from http import HTTPStatus
from typing import Any

from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState
from uvicorn.protocols.utils import ClientDisconnected
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.exceptions import PayloadTooBig
from websockets.frames import Close, Frame, Opcode
from websockets.http11 import Request

from app.api.errors import find_answer
from app.api.framing import Pieces, wrap
from app.domain.errors import (
    BadMessageError,
    DrainingError,
    KinecastError,
    TooFastError,
    TooLargeError,
)
from app.live.accounting import RateLimit
from app.live.actions import describe, take_leave
from app.live.codec import Codec
from app.live.connection import GoneError, Take
from app.live.protocol import JSON, SUBPROTOCOLS

FATAL = 4400
"""Close code of errors that end a stream only where they happen while it opens."""
LINGER_S = 2.0
"""How long a refused client may go on sending before the connection is cut: a connection that is
closed with bytes unread would be reset, and the client would never read why."""
LEAVE_S = 2.0
"""How long the reason of an end may wait for a client that reads nothing."""
PINGS_HZ, PING_BURST = 5.0, 60.0
"""WebSocket pings that a connection may send; libraries send one in some seconds."""
FLOOD = 1000
"""Frames of one read, or of one message, that are too many, whatever they hold."""
SLICE = 4096
"""Bytes that the library reads at once: of a thousand tiny frames it would see the last one, and
nobody else would have a turn, before anything could be done about the first."""
BURST = 8
"""Messages of one read that are taken at once; the rest waits, so that others have their turn."""
_SHORTCUT = "kinecast.shortcut"
ABANDON_S = 10.0
"""How long the last bytes may take to leave once a stream has ended."""


def find_close_code(error: KinecastError) -> int:
    """Give the close code of an error that ends a stream."""
    code = find_answer(type(error)).close_code
    return FATAL if code is None else code


class ClientSocket:
    """An accepted WebSocket, as `app.live.connection.Socket` describes it."""

    def __init__(self, websocket: WebSocket, *, max_message_bytes: int) -> None:
        self.close_code = 1006
        self._websocket, self._max_bytes = websocket, max_message_bytes
        self._is_binary = False
        shortcut = websocket.scope.get("extensions", {}).get(_SHORTCUT)
        self._shortcut = shortcut if isinstance(shortcut, StreamProtocol) else None

    @property
    def is_open(self) -> bool:
        """Whether neither side has closed it yet."""
        both = (self._websocket.client_state, self._websocket.application_state)
        return both == (WebSocketState.CONNECTED, WebSocketState.CONNECTED)

    async def receive(self) -> str | bytes:
        """Wait for a message; see the protocol class.

        Raises:
            GoneError: the client closed the connection or vanished.
            TooLargeError: the message is over the limit.
        """
        message = await self._websocket.receive()
        if message["type"] == "websocket.disconnect":
            self.close_code = message.get("code") or 1005
            raise GoneError
        text: str | None = message.get("text")
        data: str | bytes = message["bytes"] if text is None else text
        if len(data) > self._max_bytes:
            raise TooLargeError(f"A message may have {self._max_bytes} bytes.")
        return data

    async def send(self, data: bytes) -> None:
        """Send a message in the subprotocol's kind of frame.

        Raises:
            GoneError: the client is gone.
        """
        with _translate_gone():
            if self._is_binary:
                await self._websocket.send_bytes(data)
            else:
                await self._websocket.send_text(data.decode())

    def listen(self, take: Take | None) -> None:
        """Have messages handed over as they come, without waking a task for each of them."""
        if self._shortcut is not None:
            self._shortcut.take = take

    @property
    def is_clear(self) -> bool:
        """Whether `send_now` can send."""
        return self._shortcut is not None and self._shortcut.is_clear

    def send_now(self, data: bytes) -> None:
        """Send a message without waiting, while `is_clear`."""
        if self._shortcut is not None:
            self._shortcut.write(Opcode.BINARY if self._is_binary else Opcode.TEXT, data)

    def use(self, codec: Codec) -> None:
        """Send frames of the kind that the subprotocol has."""
        self._is_binary = codec.is_binary

    async def refuse(self, error: KinecastError, codec: Codec) -> None:
        """Say why, say goodbye and close with the error's code; do not wait for deaf clients."""
        self.use(codec)
        self.close_code = find_close_code(error)
        with contextlib.suppress(GoneError, TimeoutError):
            async with asyncio.timeout(LEAVE_S):
                if not isinstance(error, DrainingError):
                    await self.send(codec.encode(describe(error)))
                await self.send(codec.encode(take_leave(error)))
                with _translate_gone():
                    await self._websocket.close(self.close_code, error.code)


class StreamProtocol(WebSocketsSansIOProtocol):
    """Uvicorn's WebSocket protocol, with our close codes for what it refuses by itself.

    A message beyond the limit is refused by its announced length, before it is read: 4413. What is
    no WebSocket frame, or no text where text is announced: 4400.
    """

    take: Take | None = None
    """Takes messages as they come; what it does not take waits in the framework's queue."""
    _lingering = False
    _credit = 0
    _pieces: Pieces | None = None

    def __init__(self, *args: Any, **kwargs: Any) -> None:  # noqa: ANN401 - uvicorn's own
        super().__init__(*args, **kwargs)
        self._pings = RateLimit(rate_hz=PINGS_HZ, burst=PING_BURST)

    def data_received(self, data: bytes) -> None:
        """Take bytes of the client; of one that was refused, only to throw them away."""
        if self._lingering:
            return
        self._credit = BURST
        if self._pieces is None:
            self._leave_to_library(data)
            if self.handshake_initiated and data.endswith(b"\r\n\r\n"):
                self._pieces = Pieces(self.config.ws_max_size)
            return
        for number, (message, piece) in enumerate(self._pieces.split(data)):
            if number == FLOOD:
                self._give_up(TooFastError("Too many messages at once."))
            if self.is_refused:
                return
            self._read(message, piece)

    def _read(self, message: str | bytes | None, piece: bytes) -> None:
        """Hand a message over, or have the library read its bytes."""
        if message is None or not self._offer(message):
            self._leave_to_library(piece)

    def _leave_to_library(self, data: bytes) -> None:
        """Have the library read bytes, up to where the client is refused."""
        for start in range(0, len(data), SLICE):
            if not self.is_refused:
                super().data_received(data[start : start + SLICE])

    def handle_cont(self, event: Frame) -> None:
        """Take a further part of a message, but not parts without end, which may be empty."""
        if self.is_refused:
            return
        if len(self.frames) >= FLOOD:
            self._give_up(TooFastError("Too many parts of one message."))
        else:
            super().handle_cont(event)

    def handle_connect(self, event: Request) -> None:
        """Let the stream of this connection find its way past the framework."""
        super().handle_connect(event)
        if self.response.status_code == HTTPStatus.SWITCHING_PROTOCOLS:
            extensions: dict[str, Any] = self.scope["extensions"]
            extensions[_SHORTCUT] = self

    @property
    def is_refused(self) -> bool:
        """Whether the client was told to go; what it sends is thrown away."""
        return self._lingering

    def _offer(self, message: str | bytes) -> bool:
        """Hand a message over at once; where that is not possible, it is left for the task."""
        if self.take is None or not self._credit or self.close_sent or not self.queue.empty():
            return False
        self._credit -= 1
        return self.take(message)

    @property
    def is_clear(self) -> bool:
        """Whether the connection is open and the client takes what is sent."""
        is_open = self.handshake_complete and not self.close_sent and not self.disconnected
        return is_open and self.writable.is_set() and not self.transport.is_closing()

    def write(self, kind: Opcode, data: bytes) -> None:
        """Send one whole message, unmasked as servers do (RFC 6455, section 5.2)."""
        self.transport.write(wrap(kind, data))

    def handle_parser_exception(self) -> None:
        """Say what was wrong in words of our protocol, and close."""
        if not self.handshake_complete or self.close_sent:
            super().handle_parser_exception()
            return
        error: KinecastError = BadMessageError("This is no WebSocket message.")
        if isinstance(self.conn.parser_exc, PayloadTooBig):
            error = TooLargeError(f"A message may have {self.config.ws_max_size} bytes.")
        self._give_up(error)

    def handle_ping(self) -> None:
        """Answer a ping, but not a flood of them, which no limit of messages would see."""
        if self.is_refused:
            self.conn.data_to_send()
        elif self._pings.take(self.loop.time()):
            super().handle_ping()
        else:
            self._give_up(TooFastError("Too many pings."))

    def handle_pong(self, event: Frame) -> None:
        """Take no more pongs than pings: nobody asked for them."""
        if not self.is_refused and not self._pings.take(self.loop.time()):
            self._give_up(TooFastError("Too many pongs."))
        super().handle_pong(event)

    def _give_up(self, error: KinecastError) -> None:
        code = find_close_code(error)
        self.conn.data_to_send()  # the close frame that we replace
        for frame in self._farewell(error, code):
            self.transport.write(frame.serialize(mask=False))
        self.queue.put_nowait({"type": "websocket.disconnect", "code": code})
        self.close_sent = self._lingering = True
        self.transport.resume_reading()
        self.close_timer = self.loop.call_later(LINGER_S, self.transport.abort)

    async def run_asgi(self) -> None:
        """Serve the stream; afterwards cut off a client that does not take its last bytes."""
        await super().run_asgi()
        self.loop.call_later(ABANDON_S, self.transport.abort)

    def _farewell(self, error: KinecastError, code: int) -> list[Frame]:
        chosen = self.response.headers.get("Sec-WebSocket-Protocol", JSON)
        codec = Codec(chosen if chosen in SUBPROTOCOLS else JSON, joints=0)
        kind = Opcode.BINARY if codec.is_binary else Opcode.TEXT
        told, goodbye = codec.encode(describe(error)), codec.encode(take_leave(error))
        return [
            Frame(kind, told),
            Frame(kind, goodbye),
            Frame(Opcode.CLOSE, Close(code, error.code).serialize()),
        ]


@contextlib.contextmanager
def _translate_gone() -> Iterator[None]:
    """Make one error of all the ways in which the framework says that a client is gone."""
    try:
        yield
    except (WebSocketDisconnect, ClientDisconnected, RuntimeError) as error:
        raise GoneError from error
