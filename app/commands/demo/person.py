"""One synthetic person in front of an imagined sensor, streamed to a service."""

import asyncio
import random
import time
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float32

from app.commands.client.errors import ClosedError, SilenceError, UnreachableError
from app.commands.client.messages import Error, Forecast, Hello, Version, Waiting
from app.commands.client.stream import Stream, open_stream
from app.commands.demo.scores import Scores
from app.commands.demo.trials import Rehearsals
from models.data.synthetic import SensorNoise, SyntheticPerson

RATE_HZ = 30.0
CHUNK = 15
"""Frames that are invented at once, away from the clockwork that sends them."""
SILENCE_S = 5.0
FAREWELL_S = 1.0
BACK_OFF_S = (0.1, 5.0)
LATE_S = 1.0
"""A sender this late (a laptop that slept) starts its timetable anew."""


@dataclass(slots=True)
class Report:
    """What is known of one person's stream so far."""

    user: str
    action: str = ""
    state: str = "connecting"
    version: Version | None = None
    severity: str = ""
    quality: tuple[str, ...] = ()
    sent: int = 0
    answered: int = 0
    skipped: int = 0
    refused: int = 0
    reconnects: int = 0
    problem: str = ""
    scores: Scores = field(default_factory=Scores)
    trials: Rehearsals = field(default_factory=Rehearsals)


class Performer:
    """A person who never stops, and the stream of what a sensor sees of them.

    Args:
        user: whose stream it is.
        seed: who the person is.
    """

    def __init__(self, user: str, *, seed: int) -> None:
        self.report = Report(user)
        self._performance = SyntheticPerson(seed).perform(endless=True)
        self._noise = SensorNoise(seed)
        self._invented: list[tuple[str, Float32[np.ndarray, "20 3"]]] = []
        self._seq = 0
        self._due: dict[int, float] = {}

    async def perform(self, url: str, *, key: str, subprotocol: str, start: float) -> None:
        """Stream until cancelled, coming back whenever the stream is lost.

        Args:
            url: of the service.
            key: API key.
            subprotocol: of the stream.
            start: when to begin, on the clock of `time.monotonic`; people begin one after another.

        Raises:
            ClosedError: the service refuses, and would refuse again.
        """
        wait_s = BACK_OFF_S[0]
        while True:
            before = self.report.answered
            try:
                async with open_stream(
                    url, self.report.user, key=key, subprotocol=subprotocol
                ) as stream:
                    await self._serve(stream, start)
            except ClosedError as closed:
                self._lose(closed.code)
                if closed.is_final:
                    raise
                wait_s = max(wait_s, closed.retry_after_s)
            except (SilenceError, UnreachableError) as error:
                self._lose(str(error))
            wait_s = BACK_OFF_S[0] if self.report.answered > before else wait_s
            await asyncio.sleep(wait_s * random.uniform(0.5, 1.0))  # noqa: S311 - no secret
            wait_s = min(2 * wait_s, BACK_OFF_S[1])
            start = time.monotonic()

    async def _serve(self, stream: Stream, start: float) -> None:
        """Send and receive until the stream ends, which raises."""
        self._note_hello(stream.hello)
        receiver = asyncio.create_task(self._receive(stream))
        tasks = {receiver, asyncio.create_task(self._send(stream, start))}
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            if receiver not in done:  # it may still read why the stream ended
                await asyncio.wait({receiver}, timeout=FAREWELL_S)
            for task in sorted(tasks, key=lambda task: task is not receiver):
                if task.done():
                    task.result()
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def _send(self, stream: Stream, start: float) -> None:
        """Send each frame at its moment, whatever the service does."""
        frame = 0
        while True:
            due = start + frame / RATE_HZ
            now = time.monotonic()
            if now - due > LATE_S:
                start, frame = now, 0
                continue
            if not self._invented:
                self._invented = await asyncio.to_thread(self._invent)
            await asyncio.sleep(max(0.0, due - time.monotonic()))
            self.report.action, pose = self._invented.pop(0)
            self._due[self._seq] = due
            self.report.scores.see(self._seq, pose)
            await self.report.trials.before_frame(stream, self._seq, self.report.action)
            await stream.send_frame(self._seq, due, pose)
            self._seq += 1
            self.report.sent += 1
            frame += 1

    def _invent(self) -> list[tuple[str, Float32[np.ndarray, "20 3"]]]:
        """Make the next frames: what the person does, and how the sensor sees it."""
        times = (self._seq + np.arange(CHUNK)) / RATE_HZ
        poses = self._performance.pose_at(times) + self._noise.sample(times)
        names = [self._performance.action_at(float(time)) for time in times]
        return list(zip(names, poses.astype(np.float32), strict=True))

    async def _receive(self, stream: Stream) -> None:
        async for message in stream.messages(silence_s=SILENCE_S):
            report = self.report
            report.trials.hear(message, self._seq)
            match message:
                case Forecast():
                    self._note_forecast(message)
                case Waiting():
                    report.state = f"waiting: {message.reason}"
                case Error():
                    report.refused += 1
                    report.problem = message.code

    def _note_hello(self, hello: Hello) -> None:
        self.report.version, self.report.state = hello.version, "streaming"

    def _note_forecast(self, forecast: Forecast) -> None:
        report, now = self.report, time.monotonic()
        due = self._due.pop(forecast.seq, None)
        for old in [seq for seq in self._due if seq < forecast.seq]:
            del self._due[old]
        report.state = "streaming"
        report.answered += 1
        report.skipped += forecast.skipped
        report.version, report.severity = forecast.version, forecast.severity
        report.quality = forecast.quality
        if due is not None:
            report.scores.foresee(forecast.seq, forecast.frames, latency_ms=(now - due) * 1e3)

    def _lose(self, reason: str) -> None:
        report = self.report
        report.state, report.problem = f"lost: {reason}", reason
        report.reconnects += 1
        report.scores.forget()
        report.trials.lose(self._seq)
        self._due.clear()
