"""Stores recordings whose stream is gone and does not come back."""

import asyncio
import time
from collections.abc import Callable
from datetime import timedelta

import structlog

from app.domain.errors import NotReadyError
from app.live.rounds import Rounds
from app.storage.abandoned import has_abandoned, store_abandoned
from app.storage.clock import read_clock
from app.storage.database import Database

SWEEP_S = 5.0
LOOK_S = 10.0
"""Longest wait for the database."""
GRACE_S = 15.0
"""After an outage, streams that could not say that they are there get this long to do so."""

log = structlog.get_logger(__name__)


class Sweeper(Rounds):
    """Looks for abandoned recordings. Every replica may: the second one finds nothing.

    Args:
        database: where they are.
        abandoned_s: a recording without a sign of life for this long is abandoned.
        every_s: how often to look.
        clock: seconds, monotonic.
    """

    def __init__(
        self,
        database: Database,
        *,
        abandoned_s: float,
        every_s: float = SWEEP_S,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__(self.sweep, every_s=every_s)
        self._database, self._clock = database, clock
        self._abandoned = timedelta(seconds=abandoned_s)
        self._reached_since: float | None = None

    async def sweep(self) -> int:
        """Store what is abandoned now; gives how many recordings that were."""
        try:
            async with asyncio.timeout(LOOK_S):
                return await self._sweep(self._clock())
        except (NotReadyError, TimeoutError):
            self._reached_since = None
            return 0

    async def _sweep(self, now: float) -> int:
        if self._reached_since is None or now - self._reached_since < GRACE_S:
            await self._database.ping()
            self._reached_since = now if self._reached_since is None else self._reached_since
            return 0
        async with self._database.read() as tx:
            moment = await read_clock(tx)
            if not await has_abandoned(tx, before=moment - self._abandoned):
                return 0  # as nearly always: no reason to hold up who writes
        async with self._database.write() as tx:
            stored = await store_abandoned(tx, before=moment - self._abandoned, now=moment)
        if stored:
            log.info("recordings without a stream were stored", trials=len(stored))
        return len(stored)
