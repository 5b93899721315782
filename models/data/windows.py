"""Windows: what is observed and what follows it, cut from clips without crossing their ends."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int64

from models.data.clips import Clip
from models.spec import MotionSpec


@dataclass(frozen=True, eq=False)
class Windows:
    """Windows as copies, ready to be evaluated.

    Attributes:
        observed: metres in the frame of the clip.
        future: the frames that follow at once.
        clip: index of each window's clip in the list that was cut.
        start: frame of its clip at which each window starts.
    """

    observed: Float32[np.ndarray, "window observe joint 3"]
    future: Float32[np.ndarray, "window horizon joint 3"]
    clip: Int64[np.ndarray, " window"]
    start: Int64[np.ndarray, " window"]

    def __len__(self) -> int:
        return len(self.start)


@dataclass(frozen=True, eq=False)
class PackedClips:
    """Clips one after another in one array, from which a trainer gathers windows by their starts.

    Attributes:
        frames: all frames, metres.
        offsets: where each clip starts in `frames`.
        lengths: frames of each clip.
    """

    frames: Float32[np.ndarray, "frame joint 3"]
    offsets: Int64[np.ndarray, " clip"]
    lengths: Int64[np.ndarray, " clip"]

    def find_clips(self, starts: Int64[np.ndarray, " window"]) -> Int64[np.ndarray, " window"]:
        """Give the clip in which each start lies."""
        return np.searchsorted(self.offsets, starts, side="right").astype(np.int64) - 1


def pack(clips: Sequence[Clip]) -> PackedClips:
    """Put the clips one after another.

    Raises:
        ValueError: if there are no clips.
    """
    if not clips:
        raise ValueError("there are no clips to pack")
    lengths = np.array([len(clip.poses) for clip in clips], dtype=np.int64)
    return PackedClips(
        frames=np.concatenate([clip.poses for clip in clips]),
        offsets=np.cumsum(lengths) - lengths,
        lengths=lengths,
    )


def window_starts(
    packed: PackedClips, spec: MotionSpec, *, stride: int = 1
) -> Int64[np.ndarray, " window"]:
    """Find where in `packed.frames` a window can start so that it stays within its clip.

    Clips shorter than a window give none.

    Raises:
        ValueError: if `stride` is not positive.
    """
    if stride < 1:
        raise ValueError(f"stride must be positive, got {stride}")
    starts = [
        np.arange(offset, offset + length - spec.frames + 1, stride, dtype=np.int64)
        for offset, length in zip(packed.offsets, packed.lengths, strict=True)
    ]
    return np.concatenate(starts)


def cut_windows(clips: Sequence[Clip], spec: MotionSpec, *, stride: int = 1) -> Windows:
    """Cut every window of `spec.frames` consecutive frames from every clip.

    Args:
        clips: recordings at the rate of `spec`.
        spec: how much is observed and forecast.
        stride: frames between the starts of two windows of a clip.

    Raises:
        ValueError: if a clip has another rate, or no clip is long enough for a window.
    """
    for clip in clips:
        if clip.rate_hz != spec.rate_hz:
            raise ValueError(f"a clip of {clip.source} has {clip.rate_hz} Hz, not {spec.rate_hz}")
    packed = pack(clips)
    starts = window_starts(packed, spec, stride=stride)
    if not len(starts):
        raise ValueError(f"no clip has the {spec.frames} frames of a window")
    frames = packed.frames[starts[:, None] + np.arange(spec.frames)]
    clip_of = packed.find_clips(starts)
    return Windows(
        observed=frames[:, : spec.observe],
        future=frames[:, spec.observe :],
        clip=clip_of,
        start=starts - packed.offsets[clip_of],
    )
