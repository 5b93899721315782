"""Forgets what nobody needs any more, a little at a time."""

import asyncio
from collections.abc import Callable, Collection
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

import structlog
from sqlalchemy import delete, select, tuple_, update
from sqlalchemy.ext.asyncio import AsyncSession

from app.domain.errors import NotReadyError
from app.domain.jobs import JobState
from app.domain.streams import OpenStream
from app.storage.database import Database
from app.storage.tables import IdempotencyRow, JobRow, SessionRow, utc_now

EVERY_S = 300.0
BATCH = 500
"""Most rows of a table that go at a time, so that nobody waits for long."""
SEEN_EVERY = timedelta(days=1)
"""How often the name of a stream that is open all the time is marked as used."""
_FINAL = tuple(state for state in JobState if state.is_final)

log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class Forgotten:
    """How many rows went: answers to requests, jobs, names of sessions."""

    answers: int = 0
    jobs: int = 0
    sessions: int = 0


async def forget(tx: AsyncSession, *, now: datetime, kept: timedelta) -> Forgotten:
    """Remove what is too old: a batch of each kind.

    Answers to requests have their own time. Jobs go when they made no version, names of sessions
    when no stream had them, each for `kept`.
    """
    old = now - kept
    answer = (
        IdempotencyRow.key_id,
        IdempotencyRow.user_uuid,
        IdempotencyRow.route,
        IdempotencyRow.token,
    )
    failed = (JobRow.state.in_(_FINAL), JobRow.version.is_(None), JobRow.finished_at < old)
    session = (SessionRow.user_uuid, SessionRow.name)
    return Forgotten(
        answers=await _remove(tx, IdempotencyRow, answer, IdempotencyRow.expires_at <= now),
        jobs=await _remove(tx, JobRow, (JobRow.id,), *failed),
        sessions=await _remove(tx, SessionRow, session, SessionRow.opened_at < old),
    )


async def mark_used(tx: AsyncSession, streams: Collection[OpenStream], *, now: datetime) -> None:
    """Keep the names of open streams from growing old."""
    names = {(stream.user_uuid, stream.session) for stream in streams}
    if not names:
        return
    await tx.execute(
        update(SessionRow)
        .where(
            tuple_(SessionRow.user_uuid, SessionRow.name).in_(names),
            SessionRow.opened_at < now - SEEN_EVERY,
        )
        .values(opened_at=now)
        .execution_options(synchronize_session=False)
    )


async def _remove(tx: AsyncSession, table: Any, key: Any, *where: Any) -> int:  # noqa: ANN401
    """Delete a batch of rows; those that another replica is about to delete are passed over."""
    chosen = select(*key).where(*where).limit(BATCH).with_for_update(skip_locked=True)
    gone = await tx.execute(
        delete(table)
        .where(tuple_(*key).in_(chosen))
        .execution_options(synchronize_session=False)
        .returning(key[0])
    )
    return len(gone.all())


class Housekeeper:
    """Does this every few minutes. Every replica may.

    Args:
        database: what to keep tidy.
        list_open: gives the streams of this process.
        kept: how long jobs and names are kept.
        every_s: how often to do it.
    """

    def __init__(
        self,
        database: Database,
        list_open: Callable[[], Collection[OpenStream]],
        *,
        kept: timedelta,
        every_s: float = EVERY_S,
    ) -> None:
        self._database, self._list_open = database, list_open
        self._kept, self._every_s = kept, every_s
        self._task: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Begin."""
        self._task = asyncio.create_task(self._tidy_for_ever())

    async def stop(self) -> None:
        """End."""
        if self._task is not None:
            self._task.cancel()
            with suppress(asyncio.CancelledError):
                await self._task
        self._task = None

    async def tidy(self) -> Forgotten:
        """Do it once; without a database, nothing happens."""
        now = utc_now()
        try:
            async with self._database.write() as tx:
                await mark_used(tx, self._list_open(), now=now)
                gone = await forget(tx, now=now, kept=self._kept)
        except NotReadyError:
            return Forgotten()
        if gone != Forgotten():
            log.info("forgot", answers=gone.answers, jobs=gone.jobs, sessions=gone.sessions)
        return gone

    async def _tidy_for_ever(self) -> None:
        while True:
            await asyncio.sleep(self._every_s)
            await self.tidy()
