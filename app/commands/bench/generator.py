"""An open-loop load: frames leave at their scheduled instants, whatever the service does.

Latency is counted from the scheduled instant, not from the moment at which the generator got round
to sending: a slow service cannot slow down its own measurement.
"""

import asyncio
import gc
import time
from collections.abc import Iterator, Sequence
from contextlib import AsyncExitStack, contextmanager
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float32

from app.commands.bench.probe import IdleProbe, Pause
from app.commands.client.errors import SilenceError
from app.commands.client.messages import Error, Forecast, Waiting
from app.commands.client.stream import Stream, open_stream
from app.commands.client.together import run_together
from models.data.synthetic import SensorNoise, SyntheticPerson

RATE_HZ = 30.0
WARM_UP_S = 1.0
"""Frames of this long are sent first and not measured."""
LEAD_S = 0.2
LAST_S = 2.0
"""Longest wait for the last forecasts."""
SPARE_S = 60.0
"""Longest time for everything around the measurement."""
PEOPLE = 8
"""Different people; with more streams than that, some show the same motion."""


@dataclass(slots=True)
class StreamLog:
    """What happened on one stream.

    Attributes:
        sent: frames that were sent.
        late_s: how much later than scheduled each left.
        answers: of each forecast: scheduled instant, instant of arrival, the server's queue and
            compute time in milliseconds.
        skipped: frames that the service counted as superseded.
        covered: frames that a `waiting` stood for.
        refused: frames that an `error` answered, by code.
        lost: frames passed over without a word, and frames still unanswered at the end.
    """

    sent: int = 0
    late_s: list[float] = field(default_factory=list)
    answers: list[tuple[float, float, float, float]] = field(default_factory=list)
    skipped: int = 0
    covered: int = 0
    refused: dict[str, int] = field(default_factory=dict)
    lost: int = 0


@dataclass(frozen=True, slots=True)
class Load:
    """A finished run.

    Attributes:
        streams: one log each.
        pauses: of this machine or of the generator.
        begin: from when on frames count, on the clock of `time.monotonic`.
    """

    streams: tuple[StreamLog, ...]
    pauses: tuple[Pause, ...]
    begin: float


class _Client:
    """One stream of the load."""

    def __init__(self, stream: Stream, poses: Float32[np.ndarray, "time 20 3"]) -> None:
        self.log = StreamLog()
        self._stream, self._poses = stream, poses
        self._open: dict[int, float] = {}
        self._waiting_from: int | None = None
        self._all_sent = False

    async def send(self, start: float) -> None:
        """Send every frame at its instant."""
        for seq, pose in enumerate(self._poses):
            due = start + seq / RATE_HZ
            await asyncio.sleep(max(0.0, due - time.monotonic()))
            self._open[seq] = due
            self.log.late_s.append(time.monotonic() - due)
            await self._stream.send_frame(seq, due, pose)
            self.log.sent += 1
        self._all_sent = True

    async def receive(self) -> None:
        """Take answers until every frame is accounted for, or nothing more comes."""
        while self._open or not self._all_sent:
            try:
                message = await self._stream.receive(timeout_s=LAST_S)
            except SilenceError:
                break
            match message:
                case Forecast():
                    self._note_forecast(message)
                case Waiting():
                    if self._waiting_from is None:
                        self._waiting_from = message.seq
                case Error(seq=int(seq)):
                    self.log.refused[message.code] = self.log.refused.get(message.code, 0) + 1
                    self._forget([seq])
        self.log.lost += len(self._open)

    def _note_forecast(self, forecast: Forecast) -> None:
        now, timing = time.monotonic(), forecast.timing
        due = self._open.pop(forecast.seq, None)
        if due is not None:
            self.log.answers.append((due, now, timing.queue_ms, timing.compute_ms))
        passed_over = [seq for seq in self._open if seq < forecast.seq]
        self._forget(passed_over)
        self.log.skipped += forecast.skipped
        untold = max(0, len(passed_over) - forecast.skipped)
        if self._waiting_from is not None and forecast.seq > self._waiting_from:
            self.log.covered += untold  # a `waiting` stands for the frames up to the next forecast
            self._waiting_from = None
        else:
            self.log.lost += untold

    def _forget(self, seqs: Sequence[int]) -> None:
        for seq in seqs:
            self._open.pop(seq, None)


async def run_load(
    url: str, users: Sequence[str], *, key: str, subprotocol: str, seconds: float
) -> Load:
    """Stream one person for each user, and measure.

    Args:
        url: of the service.
        users: whose streams.
        key: API key.
        subprotocol: of the streams.
        seconds: how long to measure, after the warm-up.

    Raises:
        ClientError: the service cannot be reached, refuses, or ends a stream.
    """
    frames = round((WARM_UP_S + seconds) * RATE_HZ)
    people = [_invent(seed, frames) for seed in range(min(PEOPLE, len(users)))]
    probe = IdleProbe()
    async with asyncio.timeout(WARM_UP_S + seconds + SPARE_S), AsyncExitStack() as stack:
        clients = []
        for n, user in enumerate(users):
            opened = open_stream(url, user, key=key, subprotocol=subprotocol)
            stream = await stack.enter_async_context(opened)
            clients.append(_Client(stream, people[n % PEOPLE]))
        start = time.monotonic() + LEAD_S
        with _no_garbage_collection(), probe.running():
            await _drive(clients, start)
    logs = tuple(client.log for client in clients)
    return Load(logs, tuple(probe.pauses), start + WARM_UP_S)


async def _drive(clients: Sequence[_Client], start: float) -> None:
    """Run all streams, out of step with each other as people are."""
    sending = (client.send(start + n / len(clients) / RATE_HZ) for n, client in enumerate(clients))
    await run_together(*sending, *(client.receive() for client in clients))


def _invent(seed: int, frames: int) -> Float32[np.ndarray, "time 20 3"]:
    """Make all frames before the clock starts."""
    times = np.arange(frames) / RATE_HZ
    poses = SyntheticPerson(seed).perform(endless=True).pose_at(times)
    return np.asarray(poses + SensorNoise(seed).sample(times), dtype=np.float32)


@contextmanager
def _no_garbage_collection() -> Iterator[None]:
    """Keep the generator's own pauses out of the measurement."""
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
        gc.unfreeze()
