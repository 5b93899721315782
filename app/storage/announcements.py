"""Hints that something changed, so that whoever polls the database polls at once.

A hint says nothing but what to look at; nobody trusts it, and nobody needs it. Within a process it
goes straight to whoever waits; between processes it goes through Redis, where there is one. When
Redis is absent, dies or comes back, polling goes on, only slower.
"""

import asyncio
import random
from collections.abc import Collection
from contextlib import suppress
from enum import StrEnum
from typing import Literal
from uuid import uuid4
from weakref import WeakSet

import structlog
from redis.asyncio import Redis
from redis.asyncio.retry import Retry
from redis.backoff import NoBackoff
from redis.exceptions import RedisError
from sqlalchemy.ext.asyncio import AsyncSession

from app.domain.errors import StartError

CHANNEL = "kinecast:"
SEND_S = 1.0
"""Longest wait for Redis to take a hint; after it, the hint is dropped."""
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.1, 5.0
GAP_S = 0.02
"""Hints that come this close together are one, so that a flood of them is no flood of polls."""
HintState = Literal["off", "on", "away"]
_ANNOUNCED = "kinecast.announced"
_AWAY = (RedisError, OSError, TimeoutError)

log = structlog.get_logger(__name__)


class Topic(StrEnum):
    """What to look at.

    `JOBS`: a job may be claimed. `STREAMS`: what open streams look for, which is other active
    versions, erased users, revoked keys and taken session names. `PROGRESS`: a job got on.
    """

    JOBS = "jobs"
    STREAMS = "streams"
    PROGRESS = "progress"


def announce(tx: AsyncSession, *topics: Topic) -> None:
    """Have others look, once this transaction is stored; if it never is, nobody is told."""
    tx.info.setdefault(_ANNOUNCED, set()).update(topics)


def read_announced(tx: AsyncSession) -> frozenset[Topic]:
    """Give what a transaction has to tell."""
    return frozenset(tx.info.get(_ANNOUNCED, ()))


class Ear:
    """Waits for hints in place of sleeping; get it from `Announcements.listen`."""

    def __init__(self, topics: Collection[Topic]) -> None:
        self.topics = frozenset(topics)
        self.rung = asyncio.Event()

    async def wait(self, timeout_s: float) -> None:
        """Wait for a hint, at most this long. One that came since the last wait counts."""
        with suppress(TimeoutError):
            await asyncio.wait_for(self.rung.wait(), timeout_s)
            await asyncio.sleep(min(GAP_S, timeout_s))
        self.rung.clear()


class Announcements:
    """Takes hints to whoever waits, in this process and, through Redis, in others.

    Args:
        url: address of Redis, None where there is none.
        silence_s: after this long without a message, Redis is asked for a sign of life.

    Raises:
        StartError: that is no such address.
    """

    def __init__(self, url: str | None = None, *, silence_s: float = 5.0) -> None:
        self._silence_s = silence_s
        self._redis = None if url is None else _make_client(url)
        self._myself = uuid4().bytes
        self._ears: WeakSet[Ear] = WeakSet()
        self._outbox: set[Topic] = set()
        self._sending: asyncio.Task[None] | None = None
        self._listening: asyncio.Task[None] | None = None
        self._hears = False

    @property
    def state(self) -> HintState:
        """How hints from other processes fare: `off` (no Redis), `on`, or `away` for now."""
        if self._redis is None:
            return "off"
        return "on" if self._hears else "away"

    def listen(self, *topics: Topic) -> Ear:
        """Give something to wait with."""
        ear = Ear(topics)
        self._ears.add(ear)
        return ear

    def tell(self, topics: Collection[Topic]) -> None:
        """Have others look; never waits, and never fails."""
        self._ring(topics)
        if self._redis is None or not topics:
            return
        self._outbox.update(topics)
        if self._sending is None or self._sending.done():
            self._sending = asyncio.create_task(self._send(self._redis))

    def start(self) -> None:
        """Begin to listen to other processes."""
        if self._redis is not None and self._listening is None:
            self._listening = asyncio.create_task(self._listen_for_ever(self._redis))

    async def close(self) -> None:
        """Send what is left, and stop listening."""
        if self._sending is not None:
            await self._sending
        if self._listening is not None:
            self._listening.cancel()
            with suppress(asyncio.CancelledError):
                await self._listening
        self._listening, self._hears = None, False
        if self._redis is not None:
            with suppress(*_AWAY):
                await self._redis.aclose()

    def _ring(self, topics: Collection[Topic]) -> None:
        for ear in tuple(self._ears):
            if not ear.topics.isdisjoint(topics):
                ear.rung.set()

    async def _send(self, redis: Redis) -> None:
        while self._outbox:
            topics, self._outbox = self._outbox, set()
            try:
                async with asyncio.timeout(SEND_S):
                    for topic in topics:
                        await redis.publish(CHANNEL + topic, self._myself)
            except _AWAY as error:
                log.debug("hint not sent", topics=sorted(topics), why=_name(error))

    async def _listen_for_ever(self, redis: Redis) -> None:
        """Listen; when Redis goes away, say so once and try again, less and less often."""
        pause_s, told = FIRST_PAUSE_S, False
        while True:
            try:
                await self._listen(redis)
            except _AWAY as error:
                if self._hears or not told:
                    log.warning("no hints from redis; polling goes on", why=_name(error))
                    pause_s, told = FIRST_PAUSE_S, True
            self._hears = False
            await asyncio.sleep(pause_s * random.uniform(0.5, 1.0))  # noqa: S311 - no secret
            pause_s = min(2 * pause_s, LONGEST_PAUSE_S)

    async def _listen(self, redis: Redis) -> None:
        async with redis.pubsub() as channels:
            async with asyncio.timeout(self._silence_s):
                await channels.subscribe(*(CHANNEL + topic for topic in Topic))
            asked = False
            while True:
                message = await channels.get_message(timeout=self._silence_s)
                if message is None and asked:
                    raise TimeoutError("Redis gives no sign of life")
                asked = message is None
                if message is None:
                    await channels.ping()
                elif message["type"] == "subscribe":
                    self._greet()
                elif message["type"] == "message" and message["data"] != self._myself:
                    self._ring(_read_topic(message["channel"]))

    def _greet(self) -> None:
        """Look at everything once: hints may have been missed."""
        if not self._hears:
            log.info("hints from redis")
        self._hears = True
        self._ring(tuple(Topic))


def _make_client(url: str) -> Redis:
    try:
        return Redis.from_url(
            url,
            retry=Retry(NoBackoff(), 0),  # a hint that is late is worth nothing
            socket_connect_timeout=SEND_S,
            socket_timeout=SEND_S,
        )
    except ValueError:
        raise StartError("KINECAST_REDIS_URL is not the address of a Redis.") from None


def _read_topic(channel: object) -> tuple[Topic, ...]:
    """Tell what a message is about; one that is not ours is about nothing."""
    name = channel.decode(errors="replace") if isinstance(channel, bytes) else str(channel)
    with suppress(ValueError):
        return (Topic(name.removeprefix(CHANNEL)),)
    return ()


def _name(error: BaseException) -> str:
    """Name an error without its text, which may hold the address and its password."""
    return type(error).__name__
