"""An open-loop load: frames leave at their scheduled instants, whatever the service does.

Latency is counted from the scheduled instant, not from the moment at which the generator got round
to sending: a slow service cannot slow down its own measurement. Client and service share a machine,
so the generator is made to cost little: one schedule for all streams, frames that are encoded
beforehand, and no task, timer or decoded pose for any forecast.
"""

import asyncio
import gc
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float32

from app.commands.bench.accounts import StreamLog
from app.commands.bench.client import BenchClient
from app.commands.bench.probe import IdleProbe, Pause
from app.commands.bench.scenarios import (
    SLOW_RECEIVE_BYTES,
    Scenario,
    choose_slow,
    happening,
)
from app.commands.bench.usage import Sample, take_sample
from app.commands.bench.wire import LeanWire
from models.data.synthetic import SensorNoise, SyntheticPerson

RATE_HZ = 30.0
WARM_UP_S = 1.0
"""Frames of this long are sent first and not measured."""
LEAD_S = 0.2
LAST_S = 2.0
"""Longest wait for the last forecasts."""
PEOPLE = 8
"""Different people; with more streams than that, some show the same motion."""
_LOOK_S = 0.02

Send = Callable[[int, float, float], None]


@dataclass(frozen=True, slots=True)
class Load:
    """A finished run.

    Attributes:
        streams: one log each.
        pauses: of this machine or of the generator.
        begin: from when on frames count, on the clock of `time.monotonic`.
        usage: the counters at that time, and when the last frame had been sent.
    """

    streams: tuple[StreamLog, ...]
    pauses: tuple[Pause, ...]
    begin: float
    usage: tuple[Sample, Sample] | None = None


class Schedule:
    """The frames of all streams in the order in which they are due, out of step as people are.

    Args:
        senders: of each stream what sends a frame, given its number, when it was due, and the
            time; each has one frame in every 30th of a second.
        frames: of each stream.
        start: when the very first is due, on the clock of `time.monotonic`.
    """

    def __init__(self, senders: Sequence[Send], *, frames: int, start: float) -> None:
        self.sent: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._senders, self._start = senders, start
        self._step = 1 / (RATE_HZ * len(senders))
        self._next, self._total = 0, frames * len(senders)

    def send_due(self) -> None:
        """Send what is due, and come back when the next one is; no frame is left out."""
        senders, count = self._senders, len(self._senders)
        for _ in range(count):  # then a turn for those who receive
            due = self._start + self._next * self._step
            now = time.monotonic()
            if due > now:
                break
            seq, number = divmod(self._next, count)
            senders[number](seq, due, now)
            self._next += 1
            if self._next == self._total:
                self.sent.set_result(None)
                return
        due = self._start + self._next * self._step
        asyncio.get_running_loop().call_at(due, self.send_due)


async def run_load(
    url: str,
    users: Sequence[str],
    *,
    key: str,
    subprotocol: str,
    seconds: float,
    server: int | None = None,
    scenarios: frozenset[Scenario] = frozenset(),
) -> Load:
    """Stream one person for each user, and measure.

    Args:
        url: of the service.
        users: whose streams.
        key: API key.
        subprotocol: of the streams.
        seconds: how long to measure, after the warm-up.
        server: process of the service, where it is ours.
        scenarios: what happens to the clients besides.

    Raises:
        ClientError: the service cannot be reached, refuses, or ends a stream.
    """
    frames = round((WARM_UP_S + seconds) * RATE_HZ)
    wire = LeanWire(subprotocol)
    people = [wire.prepare(_invent(seed, frames)) for seed in range(min(PEOPLE, len(users)))]
    slow = choose_slow(len(users), scenarios)
    clients = [
        BenchClient(
            url,
            user,
            key=key,
            subprotocol=subprotocol,
            frames=people[n % PEOPLE],
            receive_bytes=SLOW_RECEIVE_BYTES if n in slow else None,
        )
        for n, user in enumerate(users)
    ]
    for n in slow:
        clients[n].log.slow = True
    probe = IdleProbe()
    try:
        for client in clients:
            await client.open()
        with _no_garbage_collection(), probe.running():
            begin, usage = await _drive(clients, frames, server, scenarios)
    finally:
        await asyncio.gather(*(client.close() for client in clients))
    return Load(tuple(client.log for client in clients), tuple(probe.pauses), begin, usage)


async def _drive(
    clients: Sequence[BenchClient],
    frames: int,
    server: int | None,
    scenarios: frozenset[Scenario],
) -> tuple[float, tuple[Sample, Sample]]:
    """Run all streams to their end; gives from when on frames count, and the counters."""
    loop = asyncio.get_running_loop()
    samples: list[Sample] = []
    start = time.monotonic() + LEAD_S
    schedule = Schedule([client.send for client in clients], frames=frames, start=start)
    loop.call_at(start, schedule.send_due)
    loop.call_at(start + WARM_UP_S, lambda: samples.append(take_sample(server)))
    ends: set[asyncio.Future[Any]] = {schedule.sent, *(client.failed for client in clients)}
    with happening(clients, scenarios) as tasks:
        await asyncio.wait({*ends, *tasks}, return_when=asyncio.FIRST_COMPLETED)
    await _see_out(tasks)
    samples.append(take_sample(server))
    until = time.monotonic() + LAST_S
    while time.monotonic() < until and any(client.accounts.open for client in clients):
        _raise_first(clients)
        await asyncio.sleep(_LOOK_S)
    _raise_first(clients)
    for client in clients:
        client.accounts.close(time.monotonic())
    return start + WARM_UP_S, (samples[0], samples[-1])


async def _see_out(tasks: Sequence["asyncio.Task[None]"]) -> None:
    """Wait for the end of what happened besides, and raise what went wrong with it."""
    for outcome in await asyncio.gather(*tasks, return_exceptions=True):
        if isinstance(outcome, ExceptionGroup):
            raise outcome.exceptions[0]
        if isinstance(outcome, Exception):
            raise outcome


def _raise_first(clients: Sequence[BenchClient]) -> None:
    """Raise why a stream ended, if one did."""
    for client in clients:
        if client.failed.done():
            raise client.failed.result()


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
