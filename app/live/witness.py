"""Stores whose body streams see: one more voice where trials show different people."""

import asyncio
from collections.abc import Callable, Collection
from contextlib import suppress
from typing import Protocol, runtime_checkable

from app.domain.errors import NotReadyError
from app.domain.streams import OpenStream
from app.domain.users import Lived
from app.live.rounds import Rounds
from app.storage import users
from app.storage.database import Database

EVERY_S = 30.0
STORE_S = 5.0
"""Longest wait for the database; what it does not take is forgotten, for more will be seen."""


@runtime_checkable
class Watcher(Protocol):
    """What the witness needs of an open stream."""

    stream: OpenStream

    def take_lived(self) -> Lived | None:
        """Give whose body was seen since the last time, None if not for long enough."""
        ...


class Witness(Rounds):
    """Asks the open streams now and then, and each once more at its end.

    Args:
        database: where to store.
        watchers: gives the open streams.
        every_s: how often to ask.
    """

    def __init__(
        self,
        database: Database,
        watchers: Callable[[], Collection[Watcher]],
        *,
        every_s: float = EVERY_S,
    ) -> None:
        super().__init__(self.ask, every_s=every_s)
        self._database, self._watchers = database, watchers

    async def ask(self) -> None:
        """Ask every stream once."""
        for watcher in tuple(self._watchers()):
            await self.note(watcher)

    async def note(self, watcher: Watcher) -> None:
        """Store what one stream saw."""
        lived = watcher.take_lived()
        if lived is None:
            return
        with suppress(NotReadyError, TimeoutError):
            async with asyncio.timeout(STORE_S), self._database.write() as tx:
                await users.note_lived(tx, watcher.stream.user_uuid, lived)
