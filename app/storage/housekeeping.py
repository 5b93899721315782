"""Forgets what nobody needs any more, a little at a time."""

from collections.abc import Collection
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

from sqlalchemy import delete, select, tuple_, update
from sqlalchemy.ext.asyncio import AsyncSession

from app.domain.jobs import JobState
from app.domain.streams import OpenStream
from app.settings import HISTORY_MIN_DAYS
from app.storage.tables import IdempotencyRow, JobRow, SessionRow

BATCH = 500
"""Most rows of a table that go at a time, so that nobody waits for long."""
SEEN_EVERY = timedelta(days=HISTORY_MIN_DAYS) / 4
"""How often the name of a stream that is open all the time is marked as used.

Well within any time that names are kept for: another replica may forget between two marks.
"""
_FINAL = tuple(state for state in JobState if state.is_final)


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
