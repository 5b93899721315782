"""One person on one stream: recorded, personalised, and forecast all the while.

The sensor runs at 30 Hz without a pause. Between two clips nobody is in its view for a while; those
frames are sent too, without joints, so that the window begins anew.
"""

import asyncio
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import cycle

import numpy as np
from jaxtyping import Float32

from app.commands.client.errors import SilenceError
from app.commands.client.messages import Job, Message, VersionChanged
from app.commands.client.stream import Stream, open_stream
from app.commands.client.together import run_together
from models.data.clips import Clip
from models.spec import MotionSpec

RATE_HZ = MotionSpec().rate_hz
ABSENT_FRAMES = 21
"""Nobody is seen for 0.7 s between two clips: longer than what empties a window."""
LEAD_S = 1.0
"""For opening the stream, before the first frame is due."""
LAST_S = 3.0
"""Longest wait for the answers to the last frames."""
FAILED = frozenset({"rejected", "failed", "cancelled"})
"""States of a job from which no version comes."""


@dataclass(frozen=True, slots=True)
class Place:
    """Which frame of which clip a `seq` is; `clip` counts every clip that was shown."""

    clip: int
    frame: int


@dataclass(slots=True)
class Take:
    """What was sent and what came back; times are of `time.monotonic`.

    Attributes:
        clips: everything that was shown, in its order; the first `recorded` as a trial.
        recorded: how many of them were recorded.
        places: of each `seq`; None for a frame without the person.
        due: when each `seq` was to leave.
        heard: every message with the time at which it came.
        began: when `trial.start` left.
        began_wall: the same on the wall clock.
        stopped: when `trial.stop` left.
    """

    clips: list[Clip] = field(default_factory=list)
    recorded: int = 0
    places: list[Place | None] = field(default_factory=list)
    due: list[float] = field(default_factory=list)
    heard: list[tuple[float, Message]] = field(default_factory=list)
    began: float = 0.0
    began_wall: float = 0.0
    stopped: float = 0.0

    def find(self, place: Place) -> Float32[np.ndarray, "20 3"]:
        """Give the pose that was sent."""
        return np.asarray(self.clips[place.clip].poses[place.frame])


@dataclass(frozen=True, slots=True)
class Script:
    """What happens on the stream.

    Attributes:
        record: clips of the trial.
        show: clips that follow, again and again, until the end.
        speed: how much faster than they were recorded; their times `t` stay those of 30 Hz.
        after_s: how long to go on once a version has arrived, or cannot come any more.
        patience_s: longest wait for the version after the end of the trial.
    """

    record: Sequence[Clip]
    show: Sequence[Clip]
    speed: float = 1.0
    after_s: float = 20.0
    patience_s: float = 600.0


class _Player:
    """Plays a script on a stream and writes down everything."""

    def __init__(self, stream: Stream, script: Script, *, start: float) -> None:
        self.take = Take()
        self._stream, self._script, self._start = stream, script, start
        self._news_at: float | None = None
        self._all_sent = False

    async def play(self) -> None:
        """Record the trial, then show the other clips until it is over."""
        take = self.take
        await asyncio.sleep(max(0.0, self._start - time.monotonic()))
        take.began, take.began_wall = time.monotonic(), time.time()
        await self._stream.send("trial.start", label="live")
        for clip in self._script.record:
            await self._stream.send("clip.start", action=clip.action)
            await self._show(clip)
            await self._stream.send("clip.stop")
            await self._show_nobody()
        take.recorded = len(take.clips)
        await self._stream.send("trial.stop")
        take.stopped = time.monotonic()
        for clip in cycle(self._script.show):
            if not await self._show(clip):
                break
            await self._show_nobody()
        self._all_sent = True

    async def listen(self) -> None:
        """Take what comes until the last frame is answered, or nothing more comes."""
        while not self._all_sent or not self._is_answered():
            try:
                message = await self._stream.receive(timeout_s=LAST_S)
            except SilenceError:
                if self._all_sent:
                    break
                continue  # a busy machine; what is missing will be counted
            now = time.monotonic()
            self.take.heard.append((now, message))
            if isinstance(message, VersionChanged) or (
                isinstance(message, Job) and message.state in FAILED
            ):
                self._news_at = self._news_at or now

    def _is_over(self) -> bool:
        now, stopped = time.monotonic(), self.take.stopped
        if self._news_at is not None:
            return stopped > 0 and now > self._news_at + self._script.after_s
        return stopped > 0 and now > stopped + self._script.patience_s

    def _is_answered(self) -> bool:
        last = len(self.take.places) - 1
        return any(getattr(message, "seq", -1) == last for _, message in self.take.heard[-20:])

    async def _show(self, clip: Clip) -> bool:
        """Show a clip; tells whether to go on after it. At the end it breaks off."""
        number = len(self.take.clips)
        self.take.clips.append(clip)
        for frame, pose in enumerate(clip.poses):
            if frame >= MotionSpec().observe and self._is_over():
                return False
            await self._send(Place(number, frame), np.asarray(pose))
        return True

    async def _show_nobody(self) -> None:
        for _ in range(ABSENT_FRAMES):
            await self._send(None, None)

    async def _send(self, place: Place | None, pose: Float32[np.ndarray, "20 3"] | None) -> None:
        seq = len(self.take.places)
        due = self._start + seq / RATE_HZ / self._script.speed
        await asyncio.sleep(max(0.0, due - time.monotonic()))
        self.take.places.append(place)
        self.take.due.append(due)
        await self._stream.send_frame(seq, seq / RATE_HZ, pose)


async def play(script: Script, *, url: str, key: str, user: str, subprotocol: str) -> Take:
    """Play a script on a stream of its own.

    Raises:
        ClientError: the service cannot be reached, refuses, or ends the stream.
    """
    start = time.monotonic() + LEAD_S
    async with open_stream(
        url,
        user,
        key=key,
        subprotocol=subprotocol,
        clock=lambda: (time.monotonic() - start) * script.speed,
    ) as stream:
        player = _Player(stream, script, start=start)
        await run_together(player.play(), player.listen())
    return player.take


def list_shown(take: Take) -> Iterator[tuple[int, Place]]:
    """Give every `seq` that showed the person, with its place."""
    for seq, place in enumerate(take.places):
        if place is not None:
            yield seq, place
