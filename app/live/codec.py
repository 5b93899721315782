"""Messages to bytes and back, in JSON and in msgpack.

In msgpack arrays are bare `bin`, row-major little-endian float32 (`t_out` float64); in JSON they
are nested lists. Decoding never raises: what cannot be read becomes `Rejected` with the error that
the client is told.
"""

import json
import math
import sys
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Float
from msgspec import Raw, Struct

from app.domain.errors import (
    BadConfigureError,
    BadFrameError,
    BadMessageError,
    InvalidError,
    KinecastError,
    NanInJsonError,
    UnknownFieldError,
    WrongJointCountError,
)
from app.live.protocol import (
    INCOMING,
    MSGPACK,
    ClientMessage,
    Frame,
    Incoming,
    Observation,
    Rejected,
    Seq,
    ServerMessage,
)


class _Peek(Struct):
    """What can still be read of a message that is wrong elsewhere."""

    type: Any = None
    seq: Any = None


_JointList = list[tuple[float, float, float] | None] | None


class _BinaryFrame(Struct, tag_field="type", tag="frame", forbid_unknown_fields=True):
    """A frame in msgpack, as nearly all messages are: `Frame` read in one go."""

    seq: Seq
    t: float
    joints: bytes | None
    confidence: bytes | None = None
    replay: bool = False


class _TextFrame(Struct, tag_field="type", tag="frame", forbid_unknown_fields=True):
    """The same in JSON."""

    seq: Seq
    t: float
    joints: _JointList
    confidence: list[float] | None = None
    replay: bool = False


_FLOAT32 = np.dtype("<f4")
_MISSING = (math.nan, math.nan, math.nan)
_TYPES = frozenset(str(kind.__struct_config__.tag) for kind in INCOMING)


class Codec:
    """One subprotocol, for a skeleton of `joints` joints."""

    def __init__(self, subprotocol: str, *, joints: int) -> None:
        self.subprotocol = subprotocol
        self.is_binary = subprotocol == MSGPACK
        self._joints = joints
        wire: Any = msgspec.msgpack if self.is_binary else msgspec.json
        self._frame = wire.Decoder(_BinaryFrame if self.is_binary else _TextFrame)
        self._message = wire.Decoder(Incoming)
        self._peek = wire.Decoder(_Peek)
        self._encoder = wire.Encoder(enc_hook=_to_bin if self.is_binary else _to_lists)
        self._pose = wire.Decoder(bytes | None) if self.is_binary else wire.Decoder(_JointList)
        self._numbers = (
            wire.Decoder(bytes | None) if self.is_binary else wire.Decoder(list[float] | None)
        )

    def encode(self, message: ServerMessage) -> bytes:
        """Serialise a message; JSON as UTF-8 bytes."""
        encoded: bytes = self._encoder.encode(message)
        return encoded

    def decode(self, data: str | bytes) -> ClientMessage:
        """Read a message. Text where bytes are due, or the reverse, is broken framing."""
        if isinstance(data, str) == self.is_binary:
            kind = "binary" if self.is_binary else "text"
            return Rejected(BadMessageError(f"{self.subprotocol} has {kind} messages."))
        raw = data.encode() if isinstance(data, str) else data
        try:
            frame = self._frame.decode(raw)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            return self._decode_other(raw)  # another message, or a frame with something wrong
        try:
            _check_time(frame.t)
            pose, confidence = self._read_pose(frame.joints), _read_numbers(frame.confidence)
        except KinecastError as error:
            return Rejected(error, frame.seq)
        return Observation(frame.seq, frame.t, pose, confidence, frame.replay)

    def _decode_other(self, raw: bytes) -> ClientMessage:
        """Read any message, arrays apart from the rest, so that errors can name their frame."""
        try:
            message: Incoming = self._message.decode(raw)
        except msgspec.ValidationError as error:
            return self._explain(raw, str(error))
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            return self._explain_broken(raw, str(error))
        if not isinstance(message, Frame):
            return message
        try:
            _check_time(message.t)
            pose = self._read_pose(self._read(self._pose, message.joints, "joints"))
            confidence = _read_numbers(self._read(self._numbers, message.confidence, "confidence"))
        except KinecastError as error:
            return Rejected(error, message.seq)
        return Observation(message.seq, message.t, pose, confidence, message.replay)

    def _read_pose(self, given: bytes | _JointList) -> Float[np.ndarray, "joint 3"] | None:
        if given is None:
            return None
        if isinstance(given, bytes):
            if len(given) % 12:
                raise BadFrameError(f"joints must have 12 bytes per joint, got {len(given)} bytes.")
            pose = np.frombuffer(given, _FLOAT32).astype(np.float64).reshape(-1, 3)
        else:
            rows = [_MISSING if joint is None else joint for joint in given]
            pose = np.array(rows, dtype=np.float64).reshape(-1, 3)
        if len(pose) != self._joints:
            raise WrongJointCountError(f"{self._joints} joints are expected, got {len(pose)}.")
        return pose

    def _read(self, decoder: Any, raw: Raw, name: str) -> Any:  # noqa: ANN401 - any of both formats
        try:
            return decoder.decode(raw) if memoryview(raw) else None
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            form = "little-endian float32 bytes" if self.is_binary else "lists of numbers"
            raise BadFrameError(f"{name} must be {form}: {error}.") from None

    def _explain(self, raw: bytes, problem: str) -> Rejected:
        """Say what is wrong with a well-formed message of another shape."""
        try:
            peek = self._peek.decode(raw)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            return self._explain_broken(raw, str(error))
        seq = peek.seq if isinstance(peek.seq, int) and not isinstance(peek.seq, bool) else None
        if not isinstance(peek.type, str) or peek.type not in _TYPES:
            return Rejected(InvalidError("There is no message of this type."), seq)
        if "unknown field" in problem:
            return Rejected(UnknownFieldError(f"{peek.type}: {problem}."), seq)
        kinds = {"frame": BadFrameError, "configure": BadConfigureError}
        return Rejected(kinds.get(peek.type, InvalidError)(f"{peek.type}: {problem}."), seq)

    def _explain_broken(self, raw: bytes, problem: str) -> Rejected:
        """Tell NaN in JSON, which many encoders write, from broken framing."""
        if self.is_binary:
            return Rejected(BadMessageError("This is no msgpack object."))
        try:
            lenient = json.loads(raw.decode())  # bytes would be searched for other encodings
        except (ValueError, RecursionError):
            return Rejected(BadMessageError("This is no JSON."))
        if not isinstance(lenient, dict):
            return Rejected(BadMessageError("A message must be an object."))
        seq = lenient.get("seq")
        if b"NaN" in raw or b"Infinity" in raw:
            return Rejected(NanInJsonError(), seq if type(seq) is int else None)
        return Rejected(
            BadFrameError(f"This cannot be read: {problem}."), seq if type(seq) is int else None
        )


def _check_time(t: float) -> None:
    if not math.isfinite(t):
        raise BadFrameError("t must be a finite number of seconds.")


def _read_numbers(given: bytes | list[float] | None) -> Float[np.ndarray, " number"] | None:
    if given is None:
        return None
    if isinstance(given, bytes):
        if len(given) % 4:
            raise BadFrameError("confidence must have 4 bytes per joint.")
        return np.frombuffer(given, _FLOAT32).astype(np.float64)
    return np.array(given, dtype=np.float64)


def _to_bin(value: object) -> object:
    """Give an array as its bytes; float32 and float64 are little-endian on every host."""
    if isinstance(value, np.ndarray):
        if sys.byteorder == "big":
            value = value.astype(value.dtype.newbyteorder("<"))
        return value.tobytes()
    raise TypeError(f"{type(value).__name__} cannot be sent")


def _to_lists(value: object) -> object:
    """Give an array as lists; coordinates to the micrometre, times in full."""
    if isinstance(value, np.ndarray):
        if value.dtype == np.float32:
            return value.astype(np.float64).round(6).tolist()
        return value.tolist()
    raise TypeError(f"{type(value).__name__} cannot be sent")
