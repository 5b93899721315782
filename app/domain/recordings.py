"""Frames as they were received, and the compact bytes in which they are kept.

A chunk is zlib over msgpack: times in float64, joints and confidences in float32, little-endian.
Nothing is filled in, resampled or rotated: what a robot sent stays what it sent.
"""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NoReturn

import msgspec
import numpy as np
from jaxtyping import Float32, Float64

FORMAT = 1
_LEVEL = 3
"""Float coordinates hardly get smaller beyond that, only slower."""
_MAX_RATIO = 1100
"""zlib cannot do better than about 1030 to 1: more is no chunk of ours."""


class DamagedChunkError(ValueError):
    """Stored bytes that are no chunk."""


@dataclass(frozen=True, eq=False)
class RawFrames:
    """Frames of one clip as received.

    Attributes:
        t: capture times in seconds, on the client's clock.
        joints: metres, in the user's skeleton and frame of reference; NaN where missing.
        confidence: 0 … 1 per joint, None where none was sent.
    """

    t: Float64[np.ndarray, " time"]
    joints: Float32[np.ndarray, "time joint 3"]
    confidence: Float32[np.ndarray, "time joint"] | None = None

    def __len__(self) -> int:
        return len(self.t)

    @property
    def seconds(self) -> float:
        """Time from the first frame to the last one."""
        return float(self.t[-1] - self.t[0]) if len(self.t) else 0.0


class _Chunk(msgspec.Struct, array_like=True):
    format: int
    frames: int
    joints: int
    t: bytes
    poses: bytes
    confidence: bytes | None


def pack_frames(frames: RawFrames) -> bytes:
    """Write frames as one chunk."""
    confidence = frames.confidence
    chunk = _Chunk(
        format=FORMAT,
        frames=len(frames),
        joints=frames.joints.shape[1],
        t=frames.t.astype("<f8").tobytes(),
        poses=frames.joints.astype("<f4").tobytes(),
        confidence=None if confidence is None else confidence.astype("<f4").tobytes(),
    )
    return zlib.compress(msgspec.msgpack.encode(chunk), _LEVEL)


def unpack_frames(chunks: Sequence[bytes]) -> RawFrames:
    """Read the frames of one clip back, from all of its chunks in their order.

    Raises:
        DamagedChunkError: one of them is no chunk, or is of another skeleton than the others.
    """
    parts = [_unpack(chunk) for chunk in chunks]
    if not parts:
        raise DamagedChunkError("a clip without chunks")
    if len({part.joints.shape[1] for part in parts}) > 1:
        raise DamagedChunkError("chunks of several skeletons")
    return RawFrames(
        t=np.concatenate([part.t for part in parts]),
        joints=np.concatenate([part.joints for part in parts]),
        confidence=_join_confidence(parts),
    )


def _join_confidence(parts: Sequence[RawFrames]) -> Float32[np.ndarray, "frames joint"] | None:
    """Join confidences; where only some chunks have them, the others are sure."""
    if all(part.confidence is None for part in parts):
        return None
    return np.concatenate(
        [
            np.ones(part.joints.shape[:2], dtype=np.float32)
            if part.confidence is None
            else part.confidence
            for part in parts
        ]
    )


def _unpack(content: bytes) -> RawFrames:
    try:
        inflate = zlib.decompressobj()
        raw = inflate.decompress(content, max(64, _MAX_RATIO * len(content)))
        if not inflate.eof:
            _refuse("it is cut off")
        chunk = msgspec.msgpack.decode(raw, type=_Chunk)
    except (zlib.error, msgspec.DecodeError) as error:
        raise DamagedChunkError(f"no chunk: {error}") from error
    if chunk.format != FORMAT:
        _refuse(f"format {chunk.format}")
    shape = (chunk.frames, chunk.joints)
    return RawFrames(
        t=_read(chunk.t, "<f8", (chunk.frames,)),
        joints=_read(chunk.poses, "<f4", (*shape, 3)),
        confidence=None if chunk.confidence is None else _read(chunk.confidence, "<f4", shape),
    )


def _read(data: bytes, dtype: str, shape: tuple[int, ...]) -> np.ndarray:
    item = np.dtype(dtype)
    if min(shape) < 0 or len(data) != int(np.prod(shape)) * item.itemsize:
        _refuse("its size is not what it says")
    return np.frombuffer(data, dtype=item).reshape(shape)


def _refuse(why: str) -> NoReturn:
    raise DamagedChunkError(f"no chunk: {why}")
