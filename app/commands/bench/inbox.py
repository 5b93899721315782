"""WebSocket frames of a server, as they are in the bytes that arrive: only what a client needs."""

from enum import IntEnum

ROOM = 1 << 16
MAX_MESSAGE_BYTES = 4 << 20
_LEAST_ROOM = 1 << 12
_FINAL, _KIND, _RESERVED = 0x80, 0x0F, 0x70
_MASKED = 0x80


class Kind(IntEnum):
    """What a frame is."""

    MORE = 0x0
    TEXT = 0x1
    BINARY = 0x2
    CLOSE = 0x8
    PING = 0x9
    PONG = 0xA


_PARTS = frozenset((Kind.MORE, Kind.TEXT, Kind.BINARY))
_CONTROL = frozenset((Kind.CLOSE, Kind.PING, Kind.PONG))
_WHOLE = frozenset(_FINAL | kind for kind in (Kind.TEXT, Kind.BINARY))


class FramingError(ValueError):
    """The bytes are no WebSocket frames that a server may send without extensions."""


class Inbox:
    """A buffer that bytes are received into, and the messages in it.

    A message is a part of the buffer where it came in one frame, so it has to be read before more
    is received. Messages in several frames are put together.
    """

    def __init__(self) -> None:
        self._buffer = bytearray(ROOM)
        self._view = memoryview(self._buffer)
        self._begin = self._end = 0
        self._parts: bytearray | None = None
        self._kind: int = Kind.MORE

    def room(self) -> memoryview:
        """Give the room for what arrives next."""
        return self._view[self._end :]

    def add(self, count: int) -> None:
        """Note that so many bytes were put into the room."""
        self._end += count

    def find_line(self, mark: bytes) -> bytes | None:
        """Take the bytes up to a mark and with it, None while it is not there."""
        found = self._buffer.find(mark, self._begin, self._end)
        if found < 0:
            self._make_room(self._end - self._begin + _LEAST_ROOM)
            return None
        begin, self._begin = self._begin, found + len(mark)
        return bytes(self._view[begin : self._begin])

    def take_message(self) -> tuple[int, memoryview | bytes] | None:
        """Take the next message that is complete, and its kind; None where there is none.

        Raises:
            FramingError: it is none.
        """
        while True:
            begin, there = self._begin, self._end - self._begin
            if there < 2:
                self._make_room(_LEAST_ROOM)
                return None
            first, length = self._buffer[begin], self._buffer[begin + 1]
            head = 2 if length < 126 else 4 if length == 126 else 10
            if first & _RESERVED or length & _MASKED:
                raise FramingError("a frame with an extension, or masked as a client's")
            if length > 125 and there >= head:
                length = int.from_bytes(self._view[begin + 2 : begin + head], "big")
            if there < head + length:
                self._make_room(max(head + length, _LEAST_ROOM))
                return None
            self._begin = begin + head + length
            payload = self._view[begin + head : self._begin]
            if self._parts is None and first in _WHOLE:
                return first & _KIND, payload
            whole = self._assemble(first, payload)
            if whole is not None:
                return whole

    def _assemble(self, first: int, payload: memoryview) -> tuple[int, memoryview | bytes] | None:
        """Take a part of a message, or what came between two; gives what is complete now."""
        kind = first & _KIND
        if first & _FINAL and kind in _CONTROL:
            return kind, payload
        if kind not in _PARTS or (kind == Kind.MORE) == (self._parts is None):
            raise FramingError("a frame that has no place here")
        if self._parts is None:
            self._kind, self._parts = kind, bytearray()
        self._parts += payload
        if len(self._parts) > MAX_MESSAGE_BYTES:
            raise FramingError("a message that is too long")
        if not first & _FINAL:
            return None
        whole, self._parts = bytes(self._parts), None
        return self._kind, whole

    def _make_room(self, needed: int) -> None:
        """See to it that so many bytes fit from the first unread one on."""
        rest = self._end - self._begin
        if not rest:
            self._begin = self._end = 0
            return
        if needed > MAX_MESSAGE_BYTES:
            raise FramingError("a message that is too long")
        if self._begin + needed <= len(self._buffer) and self._end < len(self._buffer):
            return
        left = bytes(self._view[self._begin : self._end])
        if 2 * needed > len(self._buffer):
            self._buffer = bytearray(2 * needed)
            self._view = memoryview(self._buffer)
        self._view[:rest] = left
        self._begin, self._end = 0, rest
