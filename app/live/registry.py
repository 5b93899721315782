"""The open streams of this process: how many there may be, and which must close."""

import asyncio
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Protocol, runtime_checkable
from uuid import UUID

import structlog

from app.domain.errors import (
    DrainingError,
    FencedError,
    KinecastError,
    NotReadyError,
    TooFastError,
    UnauthorizedError,
    UserDeletedError,
)
from app.domain.limits import Limits
from app.domain.streams import JobNews, OpenStream, Verdict
from app.domain.users import Lived
from app.live.rounds import Mistakes, Pause, Rounds
from app.live.telemetry import Telemetry
from app.live.work import Choice

Watch = Callable[[Sequence[OpenStream]], Awaitable[Mapping[OpenStream, Verdict]]]
"""Asks the database which streams must close; raises NotReadyError where it cannot tell."""
Follow = Callable[[Collection[UUID]], Awaitable[Mapping[UUID, Choice]]]
"""Gives what is active for users, loaded; raises NotReadyError where it cannot tell."""

TICK_S = 1.0
_REASONS: dict[Verdict, type[KinecastError]] = {
    Verdict.USER_DELETED: UserDeletedError,
    Verdict.KEY_REVOKED: UnauthorizedError,
    Verdict.FENCED: FencedError,
}

log = structlog.get_logger(__name__)


@runtime_checkable
class LiveStream(Protocol):
    """What the registry needs of a connection."""

    stream: OpenStream
    closed: asyncio.Event

    def end(self, error: KinecastError) -> None:
        """Tell the client why, and close."""
        ...

    def tick(self, now: float) -> None:
        """Do what is due with the time."""
        ...

    def take_lived(self) -> Lived | None:
        """Give whose body was seen since the last time, None if not for long enough."""
        ...

    def tell_job(self, news: JobNews) -> None:
        """Tell the client how a job of its user stands."""
        ...

    def switch(self, choice: Choice) -> None:
        """Let other weights answer from the next forecast on, if they are others."""
        ...

    def set_unconfirmed(self, *, unconfirmed: bool) -> None:
        """Flag forecasts while the database cannot be asked."""
        ...


class Registry:
    """Keeps the open streams, ticks them, and closes those that the database says must close.

    Args:
        watch: asks the database.
        limits: how many streams a key and a user may have.
        telemetry: where to count.
        follow: tells what is active; None where everybody has the base.
        listen: gives a way to wait between two looks.
        watch_s: how often to ask.
        unconfirmed_s: without an answer of either for this long, forecasts are flagged.
        close_s: without an answer of `watch` for this long, streams are closed: what they serve
            may have been erased.
    """

    def __init__(
        self,
        watch: Watch,
        *,
        limits: Limits,
        telemetry: Telemetry,
        follow: Follow | None = None,
        listen: Callable[[], Pause] = lambda: asyncio.sleep,
        watch_s: float = 1.0,
        unconfirmed_s: float = 10.0,
        close_s: float = 60.0,
    ) -> None:
        self._follow = follow
        self._watch, self._limits, self._telemetry = watch, limits, telemetry
        self._unconfirmed_s, self._close_s = unconfirmed_s, close_s
        self._streams: dict[OpenStream, LiveStream] = {}
        self._of_key: Counter[UUID] = Counter()
        self._of_user: Counter[UUID] = Counter()
        self._confirmed_at = time.monotonic()
        self._lost_at: float | None = None
        self._draining = False
        self._mistakes = Mistakes("a stream")
        self._rounds = (
            Rounds(self._tick, every_s=TICK_S),
            Rounds(self._check_now, every_s=watch_s, listen=listen),
            Rounds(self.follow, every_s=watch_s, listen=listen),
        )

    def __len__(self) -> int:
        return len(self._streams)

    def list_connections(self) -> tuple[LiveStream, ...]:
        """List the connections of the open streams."""
        return tuple(self._streams.values())

    def start(self) -> None:
        """Begin to tick and to watch."""
        self._confirmed_at = time.monotonic()
        for rounds in self._rounds:
            rounds.start()

    async def stop(self) -> None:
        """Stop ticking and watching."""
        for rounds in self._rounds:
            await rounds.stop()

    async def drain(self, timeout_s: float) -> None:
        """Take no more streams, say goodbye to those that are open and wait for them to end."""
        self._draining = True
        waits = [asyncio.create_task(one.closed.wait()) for one in self._streams.values()]
        for stream in list(self._streams.values()):
            stream.end(DrainingError())
        if waits:
            _, pending = await asyncio.wait(waits, timeout=timeout_s)
            for task in pending:
                task.cancel()

    def refuse_when_draining(self) -> None:
        """Refuse a new stream when this process is about to stop.

        Raises:
            DrainingError: it is.
        """
        if self._draining:
            raise DrainingError

    @contextmanager
    def take_seat(self, *, key_id: UUID, user_uuid: UUID) -> Iterator[None]:
        """Count a stream against its limits for as long as the context lasts.

        Raises:
            TooFastError: the key or the user has too many streams.
        """
        limits = self._limits
        if self._of_key[key_id] >= limits.streams_per_key:
            raise TooFastError(
                f"A key may have {limits.streams_per_key} streams (streams_per_key)."
            )
        if self._of_user[user_uuid] >= limits.streams_per_user:
            most = limits.streams_per_user
            raise TooFastError(f"A user may have {most} streams (streams_per_user).")
        self._of_key[key_id] += 1
        self._of_user[user_uuid] += 1
        try:
            yield
        finally:
            for counter, key in ((self._of_key, key_id), (self._of_user, user_uuid)):
                counter[key] -= 1
                if not counter[key]:
                    del counter[key]

    @contextmanager
    def keep(self, stream: LiveStream) -> Iterator[None]:
        """Watch over a stream for as long as the context lasts; fence those it replaces here."""
        self.refuse_when_draining()
        mine = stream.stream
        for other in list(self._streams.values()):
            theirs = other.stream
            same = (theirs.user_uuid, theirs.session) == (mine.user_uuid, mine.session)
            if same and theirs.epoch < mine.epoch:
                other.end(FencedError())
        self._streams[mine] = stream
        self._telemetry.stream_opened()
        try:
            yield
        finally:
            del self._streams[mine]
            self._telemetry.stream_closed()

    async def check(self, now: float) -> None:
        """Ask the database once, and close what must close.

        Args:
            now: monotonic clock, seconds.
        """
        try:
            async with asyncio.timeout(self._unconfirmed_s):
                verdicts = await self._watch(tuple(self._streams))
        except (NotReadyError, TimeoutError):
            self._doubt(now)
            return
        self._confirmed_at = now
        unconfirmed = self._is_unconfirmed(now)
        for stream in list(self._streams.values()):
            stream.set_unconfirmed(unconfirmed=unconfirmed)
            verdict = verdicts.get(stream.stream)
            if verdict is not None:
                stream.end(_REASONS[verdict]())

    async def follow(self) -> None:
        """Ask once what is active, and have the streams go over to it.

        Apart from `check`, so that loading weights does not hold up what must close.
        """
        if self._follow is None:
            return
        began = time.monotonic()
        try:
            streams = dict(self._streams)  # one that opens meanwhile may know better
            choices = await self._follow({stream.user_uuid for stream in streams})
        except NotReadyError:
            self._lost_at = began if self._lost_at is None else self._lost_at
            return
        self._lost_at = None
        for stream in streams.values():
            choice = choices.get(stream.stream.user_uuid)
            if choice is not None:
                with self._guard():
                    stream.switch(choice)

    def _is_unconfirmed(self, now: float) -> bool:
        """Tell whether the database has been silent for too long, to `check` or to `follow`."""
        since = self._confirmed_at if self._lost_at is None else self._lost_at
        return now - min(since, self._confirmed_at) > self._unconfirmed_s

    def _doubt(self, now: float) -> None:
        """Flag and close what the database has not confirmed for too long."""
        if not self._is_unconfirmed(now):
            return
        for stream in list(self._streams.values()):
            stream.set_unconfirmed(unconfirmed=True)
            if now - self._confirmed_at > self._close_s:
                stream.end(NotReadyError("The database has been out of reach for too long."))

    async def _tick(self) -> None:
        self._doubt(time.monotonic())  # here too: a question may hang for long before it fails
        for stream in list(self._streams.values()):
            with self._guard():
                stream.tick(time.monotonic())

    @contextmanager
    def _guard(self) -> Iterator[None]:
        """Let a mistake in one stream harm no other."""
        try:
            yield
        except Exception as error:  # noqa: BLE001 - whatever it is, the others go on
            self._mistakes.tell(error)

    async def _check_now(self) -> None:
        await self.check(time.monotonic())
