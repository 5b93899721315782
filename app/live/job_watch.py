"""Tells open streams how the fine-tuning jobs of their users stand."""

import asyncio
import time
from collections.abc import Awaitable, Callable, Collection, Sequence
from dataclasses import dataclass
from datetime import timedelta
from typing import Any, Protocol, runtime_checkable
from uuid import UUID

from app.domain.errors import NotReadyError
from app.domain.jobs import JobState
from app.domain.streams import JobNews, OpenStream
from app.live.rounds import Pause, Rounds
from app.storage.announcements import Announcements, Topic
from app.storage.clock import read_clock
from app.storage.database import Database
from app.storage.job_news import read_job_news

LOOK_BACK = timedelta(seconds=5)
"""Jobs that ended within this are told of, as they may have begun and ended between two looks."""
LOOK_S = 10.0
"""Longest wait for the database to tell."""
PROGRESS_S = 1.0
"""Mere progress is told of this often at most."""


@runtime_checkable
class Listener(Protocol):
    """What the watch needs of an open stream."""

    stream: OpenStream

    def tell_job(self, news: JobNews) -> None:
        """Tell the client how a job stands."""
        ...


Listeners = Callable[[], Collection[Listener]]
ReadNews = Callable[[Collection[UUID], Collection[UUID]], Awaitable[Sequence[JobNews]]]
"""Gives the news for these users, and of these jobs; raises NotReadyError where it cannot."""


def read_from(database: Database) -> ReadNews:
    """Read the news from a database."""

    async def read(users: Collection[UUID], known: Collection[UUID]) -> Sequence[JobNews]:
        async with database.read() as tx:
            since = await read_clock(tx) - LOOK_BACK
            return await read_job_news(tx, users, known=known, since=since)

    return read


def listen_to(announcements: Announcements) -> Callable[[], Pause]:
    """Wait for hints: for one that jobs began or ended at any time, for mere progress seldom.

    Each training process tells of itself several times a second. Nobody is told that often, so
    that nobody needs to look either.
    """

    def listen() -> Pause:
        turns = announcements.listen(Topic.JOBS)
        every = announcements.listen(Topic.JOBS, Topic.PROGRESS)

        async def wait(seconds: float) -> None:
            began = time.monotonic()
            await turns.wait(min(seconds, PROGRESS_S))
            if seconds > PROGRESS_S <= time.monotonic() - began:  # nothing but progress so far
                await every.wait(seconds - PROGRESS_S)

        return wait

    return listen


class JobWatch(Rounds):
    """Looks at the jobs of everybody who has an open stream, in one query; none without streams.

    Args:
        read: gives the news.
        listeners: gives the open streams.
        listen: gives a way to wait between two looks.
        every_s: how often to look.
    """

    def __init__(
        self,
        read: ReadNews,
        listeners: Listeners,
        *,
        listen: Callable[[], Pause] = lambda: asyncio.sleep,
        every_s: float = 1.0,
    ) -> None:
        super().__init__(self._look_now, every_s=every_s, listen=listen)
        self._read, self._listeners = read, listeners
        self._told: dict[OpenStream, dict[UUID, _Told]] = {}
        self._known: frozenset[UUID] = frozenset()

    async def look(self, now: float) -> None:
        """Look once, and tell what changed to every stream that was not told.

        Args:
            now: monotonic clock, seconds.
        """
        listeners = tuple(self._listeners())
        if not listeners:
            self._told, self._known = {}, frozenset()
            return
        try:
            users = {listener.stream.user_uuid for listener in listeners}
            async with asyncio.timeout(LOOK_S):
                news = await self._read(users, self._known)
        except (NotReadyError, TimeoutError):  # the registry deals with that
            return
        self._known = frozenset(one.id for one in news if not one.state.is_final)
        self._told = {one.stream: self._tell(one, news, now) for one in listeners}

    def _tell(self, listener: Listener, news: Sequence[JobNews], now: float) -> dict[UUID, "_Told"]:
        """Tell a stream what is new to it; gives what it knows then."""
        before = self._told.get(listener.stream, {})
        after = {}
        for one in news:
            if one.user_uuid != listener.stream.user_uuid:
                continue
            known = before.get(one.id)
            if known is None or known.is_news(one, now):
                listener.tell_job(one)
                known = _Told(one.state, one.progress, now)
            after[one.id] = known
        return after

    async def _look_now(self) -> None:
        await self.look(time.monotonic())


@dataclass(frozen=True, slots=True)
class _Told:
    """What a stream knows of a job, and since when."""

    state: JobState
    progress: dict[str, Any] | None
    at: float

    def is_news(self, one: JobNews, now: float) -> bool:
        """Tell whether there is more to say now."""
        is_due = now - self.at >= PROGRESS_S
        return one.state is not self.state or (is_due and one.progress != self.progress)
