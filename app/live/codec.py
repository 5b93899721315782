"""Messages to bytes and back, in JSON and in msgpack.

In msgpack arrays are bare `bin`, row-major little-endian float32 (`t_out` float64); in JSON they
are nested lists. Decoding never raises: what cannot be read becomes `Rejected` with the error that
the client is told.
"""

import json
import math
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
    ServerMessage,
)


class _Peek(Struct):
    """What can still be read of a message that is wrong elsewhere."""

    type: Any = None
    seq: Any = None


_JointList = list[tuple[float, float, float] | None] | None
_MISSING = (math.nan, math.nan, math.nan)
_TYPES = frozenset(str(kind.__struct_config__.tag) for kind in INCOMING)


class Codec:
    """One subprotocol, for a skeleton of `joints` joints."""

    def __init__(self, subprotocol: str, *, joints: int) -> None:
        self.subprotocol = subprotocol
        self.is_binary = subprotocol == MSGPACK
        self._joints = joints
        wire: Any = msgspec.msgpack if self.is_binary else msgspec.json
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
            message: Incoming = self._message.decode(raw)
        except msgspec.ValidationError as error:
            return self._explain(raw, str(error))
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            return self._explain_broken(raw)
        if not isinstance(message, Frame):
            return message
        try:
            return self._observe(message)
        except KinecastError as error:
            return Rejected(error, message.seq)

    def _observe(self, frame: Frame) -> Observation:
        if not math.isfinite(frame.t):
            raise BadFrameError("t must be a finite number of seconds.")
        joints, confidence = self._read_pose(frame.joints), None
        if memoryview(frame.confidence):
            confidence = self._read_confidence(frame.confidence)
        return Observation(frame.seq, frame.t, joints, confidence, frame.replay)

    def _read_pose(self, raw: Raw) -> Float[np.ndarray, "joint 3"] | None:
        given = self._read(self._pose, raw, "joints")
        if given is None:
            return None
        if isinstance(given, bytes):
            if len(given) % 12:
                raise BadFrameError(f"joints must have 12 bytes per joint, got {len(given)} bytes.")
            pose = np.frombuffer(given, "<f4").reshape(-1, 3).astype(np.float64)
        else:
            rows = [_MISSING if joint is None else joint for joint in given]
            pose = np.array(rows, dtype=np.float64).reshape(-1, 3)
        if len(pose) != self._joints:
            raise WrongJointCountError(f"{self._joints} joints are expected, got {len(pose)}.")
        return pose

    def _read_confidence(self, raw: Raw) -> Float[np.ndarray, " number"] | None:
        given = self._read(self._numbers, raw, "confidence")
        if given is None:
            return None
        if isinstance(given, bytes):
            if len(given) % 4:
                raise BadFrameError("confidence must have 4 bytes per joint.")
            return np.frombuffer(given, "<f4").astype(np.float64)
        return np.array(given, dtype=np.float64)

    def _read(self, decoder: Any, raw: Raw, name: str) -> Any:  # noqa: ANN401 - any of both formats
        try:
            return decoder.decode(raw)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            form = "little-endian float32 bytes" if self.is_binary else "lists of numbers"
            raise BadFrameError(f"{name} must be {form}: {error}.") from None

    def _explain(self, raw: bytes, problem: str) -> Rejected:
        """Say what is wrong with a well-formed message of another shape."""
        try:
            peek = self._peek.decode(raw)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            return self._explain_broken(raw)
        seq = peek.seq if isinstance(peek.seq, int) and not isinstance(peek.seq, bool) else None
        if not isinstance(peek.type, str) or peek.type not in _TYPES:
            return Rejected(InvalidError("There is no message of this type."), seq)
        if "unknown field" in problem:
            return Rejected(UnknownFieldError(f"{peek.type}: {problem}."), seq)
        kinds = {"frame": BadFrameError, "configure": BadConfigureError}
        return Rejected(kinds.get(peek.type, InvalidError)(f"{peek.type}: {problem}."), seq)

    def _explain_broken(self, raw: bytes) -> Rejected:
        """Tell NaN in JSON, which many encoders write, from broken framing."""
        if self.is_binary:
            return Rejected(BadMessageError("This is no msgpack object."))
        try:
            lenient = json.loads(raw)
        except (ValueError, RecursionError):
            return Rejected(BadMessageError("This is no JSON."))
        if not isinstance(lenient, dict):
            return Rejected(BadMessageError("A message must be an object."))
        seq = lenient.get("seq")
        if b"NaN" in raw or b"Infinity" in raw:
            return Rejected(NanInJsonError(), seq if type(seq) is int else None)
        return Rejected(
            BadFrameError("A number is out of range."), seq if type(seq) is int else None
        )


def _to_bin(value: object) -> object:
    """Give an array as its bytes; float32 and float64 are little-endian on every host."""
    if isinstance(value, np.ndarray):
        return value.astype(value.dtype.newbyteorder("<"), copy=False).tobytes()
    raise TypeError(f"{type(value).__name__} cannot be sent")


def _to_lists(value: object) -> object:
    """Give an array as lists; coordinates to the micrometre, times in full."""
    if isinstance(value, np.ndarray):
        if value.dtype == np.float32:
            return value.astype(np.float64).round(6).tolist()
        return value.tolist()
    raise TypeError(f"{type(value).__name__} cannot be sent")
