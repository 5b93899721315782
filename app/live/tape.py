"""Frames of a recording on their way into the database: clips, in pieces of half a second.

What is not stored yet waits here. If that takes too long the oldest pieces are dropped, and the
clip that lost them is cut: what is left of it goes on as a clip of its own.
"""

import math
from collections import deque
from dataclasses import dataclass, field, replace

import numpy as np

from app.domain.recordings import RawFrames
from app.live.protocol import Observation
from app.live.steps import Opened, Portion

PIECE_S = 0.5
"""Frames wait for at most this long before they are to be stored."""


@dataclass(slots=True, eq=False)
class Clip:
    """A clip of which something is not stored yet, or that is still open.

    Attributes:
        action: what the person does.
        ordinal: its place within the trial, None until its first frames are written.
        frames: how many it has.
        first_t, last_t: times of the first and the newest of them, seconds.
        has_lost: whether frames of it were dropped.
    """

    action: str | None
    ordinal: int | None = None
    frames: int = 0
    first_t: float = math.nan
    last_t: float = math.nan
    has_lost: bool = False


@dataclass(slots=True, eq=False)
class _Piece:
    """Half a second of a clip."""

    clip: Clip
    since: float
    frames: list[Observation] = field(default_factory=list)
    is_closed: bool = False


class Tape:
    """What one recording has not stored yet.

    Attributes:
        stored_seq: the newest frame that is stored, None for none.
        clips_dropped: clips that lost frames.
        bytes: size of all frames of the recording, as received.
        open: the clip that frames go to, None between clips.
    """

    def __init__(self, opened: Opened, *, joints: int) -> None:
        self.stored_seq = opened.stored_seq
        self.clips_dropped = 0
        self.bytes = opened.frames * (8 + 12 * joints)
        self.open: Clip | None = None
        self._next, self._joints = opened.clips, joints
        self._pieces: deque[_Piece] = deque()
        self._writing = 0
        last = opened.last
        if last is not None:
            self.open = Clip(last.action, last.ordinal, last.frames, last.first_t, last.last_t)

    def __len__(self) -> int:
        """Count the frames that wait."""
        return sum(len(piece.frames) for piece in self._pieces)

    @property
    def clips(self) -> int:
        """How many clips have frames, or had."""
        return self._next + len(self._list_unnumbered())

    @property
    def number(self) -> int | None:
        """Ordinal of the open clip, None between clips."""
        if self.open is None or self.open.ordinal is not None:
            return None if self.open is None else self.open.ordinal
        waiting = self._list_unnumbered()
        return self._next + (waiting.index(self.open) if self.open in waiting else len(waiting))

    def begin(self, action: str | None) -> None:
        """Open a clip; the one before ends."""
        self.end()
        self.open = Clip(action)

    def end(self) -> None:
        """End the open clip."""
        self.open = None
        self.close()

    def close(self) -> None:
        """Let what waits be stored at once."""
        if self._pieces:
            self._pieces[-1].is_closed = True

    def add(self, frame: Observation, now: float) -> None:
        """Add a frame to the open clip."""
        clip = self.open
        if clip is None:
            return
        piece = self._pieces[-1] if self._pieces else None
        if piece is None or piece.is_closed or piece.clip is not clip:
            piece = _Piece(clip, since=now)
            self._pieces.append(piece)
        piece.frames.append(frame)
        piece.is_closed = now - piece.since >= PIECE_S
        clip.first_t = frame.t if not clip.frames else clip.first_t
        clip.last_t = frame.t
        clip.frames += 1
        self.bytes += 8 + (12 if frame.confidence is None else 16) * self._joints

    def take(self) -> tuple[Portion, ...]:
        """Take everything that is due for storing; `confirm` or `give_back` must follow."""
        portions: list[Portion] = []
        for piece in self._pieces:
            if not piece.is_closed:
                break
            portions.append(self._to_portion(piece))
        self._writing = len(portions)
        return tuple(portions)

    def confirm(self) -> None:
        """Note that what was taken is stored."""
        for _ in range(self._writing):
            self.stored_seq = self._pieces.popleft().frames[-1].seq
        self._writing = 0

    def give_back(self) -> None:
        """Note that what was taken may not be stored."""
        self._writing = 0

    def discard(self) -> None:
        """Forget every frame that waits."""
        self._pieces.clear()
        self._writing = 0

    def drop_older_than(self, since: float) -> list[Observation]:
        """Drop the pieces that have waited since before then, and cut their clips; gives them."""
        lost: list[Observation] = []
        while len(self._pieces) > self._writing and self._pieces[self._writing].since < since:
            piece = self._pieces[self._writing]
            del self._pieces[self._writing]
            lost += piece.frames
            self._cut(piece.clip, len(piece.frames))
        return lost

    def _cut(self, clip: Clip, lost: int) -> None:
        """Let what is left of a clip behind lost frames be another clip."""
        self.clips_dropped += not clip.has_lost
        clip.has_lost = True
        rest = [piece for piece in list(self._pieces)[self._writing :] if piece.clip is clip]
        clip.frames -= lost + sum(len(piece.frames) for piece in rest)
        left = replace(clip, ordinal=None, frames=sum(len(piece.frames) for piece in rest))
        left.first_t = rest[0].frames[0].t if rest else math.nan
        for piece in rest:
            piece.clip = left
        if self.open is clip:
            self.open = left

    def _to_portion(self, piece: _Piece) -> Portion:
        clip = piece.clip
        if clip.ordinal is None:
            clip.ordinal, self._next = self._next, self._next + 1
        seconds = piece.frames[-1].t - clip.first_t
        return Portion(clip.ordinal, clip.action, seconds, tuple(piece.frames))

    def _list_unnumbered(self) -> list[Clip]:
        clips = dict.fromkeys(piece.clip for piece in self._pieces)
        return [clip for clip in clips if clip.ordinal is None]


def to_raw(frames: tuple[Observation, ...], *, joints: int) -> RawFrames:
    """Put frames together as they were received: NaN where a joint, or the person, was not seen."""
    poses = np.full((len(frames), joints, 3), np.nan, dtype=np.float32)
    sure = np.ones((len(frames), joints), dtype=np.float32)
    for i, frame in enumerate(frames):
        if frame.joints is not None:
            poses[i] = frame.joints
        if frame.confidence is not None:
            sure[i] = frame.confidence
    unsure = any(frame.confidence is not None for frame in frames)
    t = np.array([frame.t for frame in frames], dtype=np.float64)
    return RawFrames(t=t, joints=poses, confidence=sure if unsure else None)
