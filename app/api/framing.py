"""WebSocket frames of the common kind, read and written without the library's machinery (RFC 6455).

A stream is almost only whole messages of a few hundred bytes. They are cut out here; all
that is not of this kind is left to the library, byte for byte.
"""

import struct
from collections.abc import Iterator

from websockets.frames import Opcode

try:
    from websockets.speedups import apply_mask as unmask
except ImportError:  # the library was built without its part in C
    from websockets.utils import apply_mask as unmask

_WHOLE_TEXT, _WHOLE_BINARY = 0x80 | Opcode.TEXT, 0x80 | Opcode.BINARY
_KINDS = frozenset((_WHOLE_TEXT, _WHOLE_BINARY, 0x80 | Opcode.PING, 0x80 | Opcode.PONG))
_MASKED = 0x80
_SHORT, _MEDIUM, _LONG = 125, 126, 127
_KEY = 4


class Pieces:
    """Cuts what a client sends into frames, as long as that is simple.

    Args:
        most: bytes of the longest message that is taken.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._rest = b""
        self._is_simple = True

    def split(self, data: bytes) -> Iterator[tuple[str | bytes | None, bytes]]:
        """Yield pieces of the bytes so far, oldest first; together they are all of them.

        Yields:
            The message and the bytes of its frame; or None and bytes that the library has to read.
        """
        if self._rest:
            data, self._rest = self._rest + data, b""
        start = 0
        while start < len(data):
            place = self._find_payload(data, start)
            if not self._is_simple:
                yield None, data[start:]
                return
            if place is None or place[1] > len(data):
                self._rest = data[start:]
                return
            begin, end = place
            payload = unmask(data[begin:end], data[begin - _KEY : begin])
            yield _read(data[start], payload), data[start:end]
            start = end

    def _find_payload(self, data: bytes, start: int) -> tuple[int, int] | None:
        """Find where a frame's payload begins and ends, None where its head is not whole yet.

        At the first frame of another kind all that follows is left to the library.
        """
        if data[start] not in _KINDS:
            self._is_simple = False
        if not self._is_simple or len(data) - start < 2:
            return None
        size = data[start + 1] & ~_MASKED
        begin = start + 2 + _KEY + (2 if size == _MEDIUM else 0)
        if not data[start + 1] & _MASKED or size == _LONG:
            self._is_simple = False
        if begin > len(data):
            return None
        if size == _MEDIUM:
            size = int.from_bytes(data[start + 2 : start + 4], "big")
        if size > self._most:
            self._is_simple = False
        return begin, begin + size


def _read(kind: int, payload: bytes) -> str | bytes | None:
    """Give a message; None for control frames, and for text that is none."""
    if kind == _WHOLE_BINARY:
        return payload
    if kind != _WHOLE_TEXT:
        return None
    try:
        return payload.decode()
    except UnicodeDecodeError:
        return None


def wrap(kind: Opcode, data: bytes) -> bytes:
    """Make one frame of a whole message, unmasked as servers do."""
    size, first = len(data), 0x80 | kind
    if size <= _SHORT:
        return struct.pack("!BB", first, size) + data
    if size < 2**16:
        return struct.pack("!BBH", first, _MEDIUM, size) + data
    return struct.pack("!BBQ", first, _LONG, size) + data
