"""Stores whose body streams see: one more voice where trials show different people."""

import asyncio
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from typing import Protocol, runtime_checkable
from uuid import UUID

from app.domain.errors import NotReadyError
from app.domain.streams import OpenStream
from app.domain.users import Lived
from app.live.rounds import Rounds
from app.storage import users
from app.storage.database import Database

EVERY_S = 30.0
BATCH = 100
"""Most users that one transaction stores."""
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
        """Ask every stream once, and store what they saw: of many users at a time."""
        seen = _gather(tuple(self._watchers()))
        users_seen = list(seen)
        for first in range(0, len(users_seen), BATCH):
            await self._store({user: seen[user] for user in users_seen[first : first + BATCH]})

    async def note(self, watcher: Watcher) -> None:
        """Store what one stream saw."""
        await self._store(_gather((watcher,)))

    async def _store(self, seen: Mapping[UUID, Lived]) -> None:
        if not seen:
            return
        with suppress(NotReadyError, TimeoutError):
            async with asyncio.timeout(STORE_S), self._database.write() as tx:
                await users.note_all_lived(tx, seen)


def _gather(watchers: Collection[Watcher]) -> dict[UUID, Lived]:
    """Ask streams, and blend what those of one user saw."""
    seen: dict[UUID, Lived] = {}
    for watcher in watchers:
        lived = watcher.take_lived()
        if lived is None:
            continue
        user = watcher.stream.user_uuid
        seen[user] = seen[user].join(lived) if user in seen else lived
    return seen
