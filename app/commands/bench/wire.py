"""What the load generator says and hears: made beforehand, and read only as far as it needs."""

import struct
from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Float32
from msgspec import Struct

from app.commands.client.messages import (
    MSGPACK,
    Bye,
    Error,
    Hello,
    Ping,
    Timing,
    VersionChanged,
    Waiting,
    Wire,
)

_NUMBERS = struct.Struct(">I3sd")
_MSGPACK_UINT32, _MSGPACK_T = b"\xce", b"\xa1t\xcb"


class Answer(Struct, tag_field="type", tag="forecast", gc=False):
    """A forecast without its poses, which only have to be skipped."""

    seq: int
    skipped: int
    timing: Timing


Heard = Answer | Waiting | Error | Ping | Bye | Hello | VersionChanged


class LeanWire:
    """One subprotocol, for somebody who sends frames at 30 Hz and wants to know when what comes."""

    def __init__(self, subprotocol: str) -> None:
        self._is_binary = subprotocol == MSGPACK
        self._wire = Wire(subprotocol)
        form: Any = msgspec.msgpack if self._is_binary else msgspec.json
        self._decoder, self._any = form.Decoder(Heard), form.Decoder()

    def prepare(self, poses: Float32[np.ndarray, "time joint 3"]) -> Sequence[bytes]:
        """Give the part of each pose's message that is known before it is sent."""
        whole = (_to_bytes(self._wire.encode_frame(0, 0.0, pose)) for pose in poses)
        mark = b"joints" if self._is_binary else b'"joints":'
        begin = 1 if self._is_binary else 0  # the length of the name, before it
        return [message[message.index(mark) - begin :] for message in whole]

    def encode_frame(self, seq: int, t: float, prepared: bytes) -> bytes:
        """Write a frame with one of the prepared poses."""
        if self._is_binary:
            return _MSGPACK_HEAD + _NUMBERS.pack(seq, _MSGPACK_T, t) + prepared
        return b'{"type":"frame","seq":%d,"t":%s,%b' % (seq, repr(t).encode(), prepared)

    def encode_pong(self, ping: Ping, t: float) -> bytes:
        """Write the answer to a ping."""
        return _to_bytes(self._wire.encode("pong", id=ping.id, server_t=ping.server_t, t=t))

    def decode(self, payload: memoryview | bytes) -> Heard | None:
        """Read a message; None for one of a kind that does not matter here.

        Raises:
            msgspec.DecodeError: it is broken.
        """
        try:
            heard: Heard = self._decoder.decode(payload)
        except msgspec.ValidationError:
            fields = self._any.decode(payload)
            known = {kind.__struct_config__.tag for kind in _KINDS}
            if not isinstance(fields, dict) or fields.get("type", "forecast") in known:
                raise
            return None
        return heard


def _to_bytes(message: str | bytes) -> bytes:
    return message.encode() if isinstance(message, str) else message


_KINDS: tuple[type[Struct], ...] = (Answer, Waiting, Error, Ping, Bye, Hello, VersionChanged)
_MSGPACK_HEAD = (
    b"\x84" + b"".join(map(msgspec.msgpack.encode, ("type", "frame", "seq"))) + (_MSGPACK_UINT32)
)
