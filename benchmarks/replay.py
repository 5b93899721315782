"""Recordings streamed to a running service, and its forecasts compared with what came after.

What is compared is exactly what `kinecast evaluate` scores: the same windows of the same clips, by
the same metrics, once answered over the wire and once by the net in this process.
"""

import asyncio
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, fields

import numpy as np
from jaxtyping import Float32, Int64

from app.commands.client.errors import SilenceError
from app.commands.client.messages import Error, Forecast, Waiting
from app.commands.client.rest import Api
from app.commands.client.stream import Stream, open_stream
from app.commands.client.together import run_together
from models.baselines import Forecaster
from models.data.clips import Clip
from models.data.windows import Windows, cut_windows
from models.metrics import Scores, evaluate_forecasts
from models.spec import MotionSpec
from models.training.evaluate import score_forecaster

SPEC = MotionSpec()
GAP_S = 0.7
"""Between two clips, longer than what empties a window."""
REPEATS_S = 2.0
"""Longest wait for the last answers."""


@dataclass(slots=True)
class Replay:
    """What came back.

    Attributes:
        forecasts: by clip and its frame, the newest one that the forecast used.
        sent: frames that were sent.
        skipped: frames that the service counted as superseded.
        covered: frames that a `waiting` stood for.
        unanswered: frames without an answer, a count or a `waiting`.
        errors: codes of errors that the service told.
        flags: quality flags that forecasts carried.
    """

    forecasts: dict[tuple[int, int], Float32[np.ndarray, "15 20 3"]] = field(default_factory=dict)
    sent: int = 0
    skipped: int = 0
    covered: int = 0
    unanswered: int = 0
    errors: list[str] = field(default_factory=list)
    flags: set[str] = field(default_factory=set)


class _Replayer:
    """Sends clips on one stream and keeps account of every frame."""

    def __init__(self, stream: Stream, clips: Sequence[Clip], *, speed: float) -> None:
        self.replay = Replay()
        self._stream, self._clips, self._speed = stream, clips, speed
        self._places: dict[int, tuple[int, int]] = {}
        self._open: set[int] = set()
        self._waiting_from: int | None = None
        self._all_sent = False

    async def send(self) -> None:
        """Send every clip: after a gap or, every other one, after a `reset`."""
        start, t = time.monotonic(), 0.0
        for number, clip in enumerate(self._clips):
            if number % 2:
                await self._stream.send("reset")
            else:
                t += GAP_S
            for frame, pose in enumerate(clip.poses):
                await asyncio.sleep(max(0.0, start + t / self._speed - time.monotonic()))
                seq = self.replay.sent
                self._places[seq] = (number, frame)
                self._open.add(seq)
                await self._stream.send_frame(seq, t, pose)
                self.replay.sent += 1
                t += 1.0 / clip.rate_hz
        self._all_sent = True

    async def receive(self) -> None:
        """Take answers until every frame is accounted for, or nothing more comes."""
        while self._open or not self._all_sent:
            try:
                message = await self._stream.receive(timeout_s=REPEATS_S)
            except SilenceError:
                break
            match message:
                case Forecast():
                    self._note(message)
                case Waiting():
                    if self._waiting_from is None:
                        self._waiting_from = message.seq
                case Error():
                    self.replay.errors.append(message.code)
                    if message.seq is not None:
                        self._open.discard(message.seq)
        self.replay.unanswered += len(self._open)

    def _note(self, forecast: Forecast) -> None:
        replay = self.replay
        self._open.discard(forecast.seq)
        replay.forecasts[self._places[forecast.seq]] = forecast.frames
        replay.flags |= set(forecast.quality)
        passed_over = {seq for seq in self._open if seq < forecast.seq}
        self._open -= passed_over
        replay.skipped += forecast.skipped
        untold = max(0, len(passed_over) - forecast.skipped)
        if self._waiting_from is not None and forecast.seq > self._waiting_from:
            replay.covered += (
                untold  # the message at a clip's first frame stands for those up to now
            )
            self._waiting_from = None
        else:
            replay.unanswered += untold


async def replay_clips(
    clips: Sequence[Clip], *, url: str, key: str, user: str, subprotocol: str, speed: float = 1.0
) -> Replay:
    """Stream clips to a service and gather its forecasts.

    Args:
        clips: recordings at 30 Hz.
        url: of the service.
        key: API key.
        user: whose stream.
        subprotocol: of the stream.
        speed: how much faster than they were recorded; their times `t` stay those of 30 Hz.

    Raises:
        ClientError: the service cannot be reached, refuses, or ends the stream.
    """
    begun = time.monotonic()
    seconds = sum(len(clip.poses) for clip in clips) / SPEC.rate_hz + GAP_S * len(clips)
    async with (
        asyncio.timeout(seconds / speed + 60.0),
        open_stream(
            url,
            user,
            key=key,
            subprotocol=subprotocol,
            clock=lambda: (time.monotonic() - begun) * speed,
        ) as stream,
    ):
        replayer = _Replayer(stream, clips, speed=speed)
        await run_together(replayer.send(), replayer.receive())
    return replayer.replay


async def ask_single(
    windows: Windows, *, url: str, key: str, user: str, form: str
) -> Float32[np.ndarray, "window 15 20 3"]:
    """Ask for the forecast of each window by a request of its own."""
    async with Api(url, key=key) as api:
        answers = [
            (await api.forecast(user, window, form="json" if form == "json" else "msgpack")).frames
            for window in windows.observed
        ]
    return np.stack(answers)


def select_answered(clips: Sequence[Clip], replay: Replay) -> Windows:
    """Cut the windows that were answered and whose future is recorded."""
    windows = cut_windows(clips, SPEC)
    places = zip(windows.clip, windows.start, strict=True)
    answered = [(int(c), int(s) + SPEC.observe - 1) in replay.forecasts for c, s in places]
    return pick(windows, np.flatnonzero(answered))


def pick(windows: Windows, chosen: Int64[np.ndarray, " chosen"]) -> Windows:
    """Keep some windows."""
    return Windows(*(getattr(windows, item.name)[chosen] for item in fields(Windows)))


def gather(windows: Windows, replay: Replay) -> Float32[np.ndarray, "window 15 20 3"]:
    """Give the forecasts of windows, in their order."""
    places = zip(windows.clip, windows.start, strict=True)
    return np.stack([replay.forecasts[int(c), int(s) + SPEC.observe - 1] for c, s in places])


def compare(
    forecasts: Float32[np.ndarray, "window 15 20 3"], windows: Windows, forecaster: Forecaster
) -> tuple[Scores, Scores, float]:
    """Score forecasts of a service and of the net itself on the same windows.

    Returns:
        both scores, and the largest relative difference of any of their figures.
    """
    served = evaluate_forecasts(forecasts, windows.future)
    direct = score_forecaster(forecaster, windows)
    names = ("mse_cm2", "mse_cm2_at", "mpjpe_mm")
    ours, theirs = (np.array([getattr(s, name) for name in names]) for s in (served, direct))
    return served, direct, float(np.abs(ours / theirs - 1).max())
