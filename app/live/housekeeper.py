"""Has forgotten what nobody needs any more, every few minutes."""

import asyncio
from collections.abc import Callable, Collection
from datetime import timedelta

import structlog

from app.domain.errors import NotReadyError
from app.domain.streams import OpenStream
from app.live.rounds import Rounds
from app.storage.database import Database
from app.storage.housekeeping import Forgotten, forget, mark_used
from app.storage.tables import utc_now

EVERY_S = 300.0
TIDY_S = 60.0
"""Longest wait for the database."""

log = structlog.get_logger(__name__)


class Housekeeper(Rounds):
    """Forgets every few minutes. Every replica may.

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
        super().__init__(self.tidy, every_s=every_s)
        self._database, self._list_open = database, list_open
        self._kept = kept

    async def tidy(self) -> Forgotten:
        """Do it once; without a database, nothing happens."""
        now = utc_now()
        try:
            async with asyncio.timeout(TIDY_S), self._database.write() as tx:
                await mark_used(tx, self._list_open(), now=now)
                gone = await forget(tx, now=now, kept=self._kept)
        except (NotReadyError, TimeoutError):
            return Forgotten()
        if gone != Forgotten():
            log.info("forgot", answers=gone.answers, jobs=gone.jobs, sessions=gone.sessions)
        return gone
