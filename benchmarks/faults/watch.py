"""A robot that never stops asking: one stream and single requests beside it."""

import asyncio
import time
from collections import Counter
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float32

from app.commands.client.errors import (
    ApiError,
    ClientError,
    ClosedError,
    SilenceError,
    UnreachableError,
)
from app.commands.client.messages import Forecast, Version
from app.commands.client.rest import Api
from app.commands.client.stream import Stream, open_stream
from benchmarks.faults.people import make_window
from benchmarks.faults.rig import Rig
from models.data.synthetic import SyntheticPerson

RATE_HZ = 15.0
ASK_EVERY_S = 0.25
ANSWER_S = 30.0
"""What takes longer counts as unanswered: a busy machine is not what is examined."""
BACK_AFTER_S = 0.2
MAY_REFUSE = frozenset({"not_ready", "draining", "overloaded", "unavailable"})
"""Codes that tell a client to try again; an honest answer while the database is away."""


@dataclass(frozen=True, eq=False)
class Sighting:
    """One forecast that somebody got; `frames` only where it can be computed again."""

    at: float
    version: Version
    flagged: bool
    finite: bool
    frames: Float32[np.ndarray, "horizon joint 3"] | None = None


@dataclass(eq=False)
class Log:
    """What the robot saw.

    Attributes:
        asked: single forecasts that were answered.
        streamed: forecasts of the stream.
        refused: requests that were told to come again, by code.
        away: requests that nobody took or answered while the service was gone or starting.
        unanswered: what ought to have been answered and was not.
        closes: how streams ended, by close code and reason.
        opened: streams that were opened.
    """

    asked: list[Sighting] = field(default_factory=list)
    streamed: list[Sighting] = field(default_factory=list)
    refused: Counter[str] = field(default_factory=Counter)
    away: int = 0
    unanswered: list[str] = field(default_factory=list)
    closes: Counter[str] = field(default_factory=Counter)
    opened: int = 0

    def answered_since(self, moment: float) -> float | None:
        """Give when both ways had an answer again that was asked for after a moment."""
        first = [
            next((sighting.at for sighting in seen if sighting.at > moment), None)
            for seen in (self.asked, self.streamed)
        ]
        return None if None in first else max(at for at in first if at is not None)


@asynccontextmanager
async def watch(rig: Rig, user: str, *, seed: int) -> AsyncIterator[Log]:
    """Ask for forecasts in both ways for as long as the block lasts."""
    log, stop = Log(), asyncio.Event()
    async with asyncio.TaskGroup() as group:
        group.create_task(_ask(rig, user, log, stop, seed=seed))
        group.create_task(_keep_streaming(rig, user, log, stop, seed=seed))
        try:
            yield log
        finally:
            stop.set()


async def _ask(rig: Rig, user: str, log: Log, stop: asyncio.Event, *, seed: int) -> None:
    window = make_window(seed)
    async with Api(rig.url, key=rig.key, wait_s=ANSWER_S) as api:
        while not stop.is_set():
            was_up = rig.is_up
            try:
                answer = await api.forecast(user, window)
            except ApiError as error:
                if error.code in MAY_REFUSE:
                    log.refused[error.code] += 1
                else:
                    log.unanswered.append(str(error))
            except (SilenceError, UnreachableError) as error:
                if was_up and rig.is_up:
                    log.unanswered.append(str(error))
                log.away += 1
            else:
                finite = bool(np.isfinite(answer.frames).all())
                flagged = "fallback" in answer.quality
                now = time.monotonic()
                log.asked.append(Sighting(now, answer.version, flagged, finite, answer.frames))
            await asyncio.sleep(ASK_EVERY_S)


async def _keep_streaming(rig: Rig, user: str, log: Log, stop: asyncio.Event, *, seed: int) -> None:
    """Stream, and come back whenever the stream ends, as a robot does."""
    while not stop.is_set():
        was_up = rig.is_up
        try:
            async with open_stream(rig.url, user, key=rig.key, wait_s=ANSWER_S) as stream:
                log.opened += 1
                await _stream(stream, log, stop, seed=seed)
        except ClosedError as error:
            log.closes[f"{error.close_code} {error.code}"] += 1
            if error.is_final:
                log.unanswered.append(f"stream: {error}")
        except SilenceError as error:
            if was_up and rig.is_up and not stop.is_set():
                log.unanswered.append(f"stream: {error}")
        except UnreachableError:
            log.away += 1
        await asyncio.sleep(BACK_AFTER_S)


async def _stream(stream: Stream, log: Log, stop: asyncio.Event, *, seed: int) -> None:
    """Send and receive until asked to stop; raises as the stream ends."""
    await stream.send("configure", max_age_ms=60_000)  # as above
    sending = asyncio.create_task(_send(stream, seed=seed))
    try:
        while not stop.is_set():
            message = await stream.receive()
            if isinstance(message, Forecast):
                finite = bool(np.isfinite(message.frames).all())
                flagged = "fallback" in message.quality
                log.streamed.append(Sighting(time.monotonic(), message.version, flagged, finite))
    finally:
        sending.cancel()
        await asyncio.gather(sending, return_exceptions=True)


async def _send(stream: Stream, *, seed: int) -> None:
    began = time.monotonic()
    for seq, (t, pose) in enumerate(SyntheticPerson(seed).stream(RATE_HZ)):
        await asyncio.sleep(max(0.0, began + t - time.monotonic()))
        try:
            await stream.send_frame(seq, began + t, pose)
        except ClientError:
            return  # whoever receives learns why
