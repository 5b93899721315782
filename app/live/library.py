"""Which weights answer whom: asks the database, loads what is missing, and says why it changed.

Weights are read and built off the event loop and off the engine's thread. A choice holds what it
chose, so that nothing which is still in use can be dropped.
"""

import asyncio
import time
from collections.abc import AsyncIterator, Collection
from contextlib import asynccontextmanager
from dataclasses import dataclass
from functools import partial
from uuid import UUID
from weakref import WeakValueDictionary

import structlog

from app.domain.errors import (
    NotReadyError,
    UnknownVersionError,
    VersionUnavailableError,
    WeightsDamagedError,
    WeightsPurgedError,
)
from app.domain.motion import RequestedVersion, VersionStamp
from app.domain.versions import ActiveVersion
from app.live.decoders import Decoders, UnusableWeightsError, read_bones
from app.live.shelf import Shelf
from app.live.work import Choice
from app.storage import versions, weights
from app.storage.database import Database
from models.baselines import Forecaster

READ_S = 5.0
"""Longest wait for what one look into the database has to tell."""
RETRY_S = 10.0
"""How long weights that could not be used, and what stands behind them, are not tried again."""
_UNUSABLE = (UnusableWeightsError, WeightsPurgedError, WeightsDamagedError)

log = structlog.get_logger(__name__)


@dataclass(slots=True)
class _Followed:
    """What somebody with an open stream has.

    Attributes:
        active: their version.
        reason: why it is active.
        choice: what answers, held for as long as their streams are open.
        tried_at: when a way around weights that fail was looked for, monotonic seconds.
    """

    active: ActiveVersion
    reason: str
    choice: Choice
    tried_at: float | None = None


class Library:
    """The personal weights of this process.

    Args:
        database: where versions and their weights are.
        decoders: builds decoders from weights.
    """

    def __init__(self, database: Database, decoders: Decoders) -> None:
        self.database, self._decoders = database, decoders
        self._shelf = Shelf()
        self._failed_at: dict[str, float] = {}
        self._loading: WeakValueDictionary[str, asyncio.Lock] = WeakValueDictionary()
        self._seen: dict[UUID, _Followed] = {}

    def loaded(self) -> frozenset[str]:
        """Give the digests of the decoders that are held in memory."""
        return self._shelf.list_digests()

    async def choose(self, user_uuid: UUID, requested: RequestedVersion) -> Choice:
        """Give what a request means now, ready to forecast.

        Raises:
            VersionUnavailableError: a pinned version that there is not, or that cannot be used.
            NotReadyError: the database cannot be reached.
        """
        if requested in {"base", 0}:
            return Choice(self._decoders.resolve(requested))
        if requested != "active":
            return await self._pin(user_uuid, int(requested))
        async with _in_time(), self.database.read() as tx:
            active = await versions.read_active_of(tx, user_uuid)
        return await self._make(user_uuid, active)

    async def follow(self, user_uuids: Collection[UUID]) -> dict[UUID, Choice]:
        """Give what is active for users with open streams; called again and again.

        Raises:
            NotReadyError: the database cannot be reached.
        """
        loaded = self.loaded()
        if not user_uuids and not loaded:
            self._seen.clear()
            return {}
        async with _in_time(), self.database.read() as tx:
            found = await versions.read_active(tx, user_uuids)
            stored = await weights.list_stored(tx, loaded)
        for sha256 in loaded - stored:  # purged, or erased with its user
            self._shelf.drop(sha256)
        active = {user: found.get(user, ActiveVersion()) for user in user_uuids}
        for user in [user for user in self._seen if user not in active]:
            self._leave(user)
        for user, version in active.items():
            await self._follow_one(user, version)
        self._tidy()
        return {user: self._seen[user].choice for user in active}

    async def _follow_one(self, user_uuid: UUID, active: ActiveVersion) -> None:
        """Make somebody's choice anew where they have another version, or one that fails."""
        seen = self._seen.get(user_uuid)
        if seen is None or seen.active != active:
            reason = await self._explain(user_uuid)
            choice = await self._make(user_uuid, active, reason)
            seen = self._seen[user_uuid] = _Followed(active, reason, choice)
        elif self._needs_help(seen):
            seen.choice = await self._make(user_uuid, active, seen.reason)
        else:
            return
        if self._is_in_need(seen.choice):
            seen.tried_at = time.monotonic()

    def _leave(self, user_uuid: UUID) -> None:
        """Forget somebody without streams; what they had is what was in use last."""
        for sha256 in _list_used(self._seen.pop(user_uuid).choice):
            self._shelf.find(sha256)

    def _tidy(self) -> None:
        self._shelf.tidy(
            {sha256 for seen in self._seen.values() for sha256 in _list_used(seen.choice)}
        )

    def _needs_help(self, seen: _Followed) -> bool:
        """Tell whether a way around weights that fail is to be looked for (again)."""
        if not self._is_in_need(seen.choice):
            return False
        return seen.tried_at is None or time.monotonic() - seen.tried_at >= RETRY_S

    def _is_in_need(self, choice: Choice) -> bool:
        """Tell whether weights could not be used, or fail and have nothing at hand behind them."""
        if choice.stamp.fallback is not None:
            return True
        return choice.previous is None and self._keeps_failing(choice.stamp.sha256)

    def _keeps_failing(self, sha256: str | None) -> bool:
        return sha256 is not None and self._decoders.breaker.is_failing(sha256)

    async def _explain(self, user_uuid: UUID) -> str:
        async with _in_time(), self.database.read() as tx:
            history = await versions.list_history(tx, user_uuid)
        return history[-1].kind.value if history else "promoted"

    async def _make(self, user_uuid: UUID, active: ActiveVersion, reason: str = "") -> Choice:
        """Give the choice for an active version, or what is next best where it cannot be used."""
        if active.sha256 is None:
            return Choice(self._decoders.resolve("active"), reason=reason)
        try:
            forecaster = await self._load(active.sha256, active.base_sha256)
        except _UNUSABLE:
            missing = self._decoders.stamp_base("active", fallback="weights_missing")
            previous = await self._load_previous(user_uuid)
            return previous or Choice(missing, reason="weights_missing")
        stamp = VersionStamp(active.number, "personal", active.sha256, share=1.0)
        previous = None
        if self._keeps_failing(active.sha256):
            previous = await self._load_previous(user_uuid)
        return Choice(stamp, forecaster, reason, previous, read_bones(forecaster))

    async def _load_previous(self, user_uuid: UUID) -> Choice | None:
        """Give what was active before, None where that is the base or cannot be used either."""
        try:
            async with _in_time(), self.database.read() as tx:
                previous = await versions.read_previous(tx, user_uuid)
            if previous.sha256 is None:
                return None
            forecaster = await self._load(previous.sha256, previous.base_sha256)
        except (UnknownVersionError, *_UNUSABLE):  # unknown: erased with its user in between
            return None
        stamp = VersionStamp(
            previous.number, "personal", previous.sha256, share=1.0, fallback="previous_version"
        )
        bones = read_bones(forecaster)
        return Choice(stamp, forecaster, reason="weights_missing", bones=bones)

    async def _pin(self, user_uuid: UUID, number: int) -> Choice:
        try:
            async with _in_time(), self.database.read() as tx:
                version = await versions.get(tx, user_uuid, number)
            forecaster = await self._load(version.sha256, version.base_sha256)
        except UnknownVersionError as error:
            raise VersionUnavailableError(error.message) from None
        except _UNUSABLE as error:
            message = f"The weights of version {number} cannot be used: {error}."
            raise VersionUnavailableError(message) from None
        stamp = VersionStamp(number, "personal", version.sha256, requested=number, share=1.0)
        return Choice(stamp, forecaster, bones=read_bones(forecaster))

    async def _load(self, sha256: str, base_sha256: str | None) -> Forecaster:
        """Give a decoder behind its base, both from the database if they are not there yet.

        Raises:
            UnusableWeightsError, WeightsPurgedError, WeightsDamagedError: it cannot be used.
        """
        lock = self._loading.setdefault(sha256, asyncio.Lock())
        async with lock:  # of these weights: nobody waits for somebody else's
            known = self._shelf.find(sha256)
            if known is not None:
                return known
            self._refuse_what_failed(sha256)
            try:
                forecaster = await self._fetch(sha256, base_sha256)
            except _UNUSABLE as error:
                self._failed_at[sha256] = time.monotonic()
                log.warning("weights cannot be used", sha256=sha256, why=str(error))
                raise
            self._failed_at.pop(sha256, None)
            self._shelf.put(sha256, forecaster)
            self._tidy()
            return forecaster

    async def _fetch(self, sha256: str, base_sha256: str | None) -> Forecaster:
        build = partial(self._decoders.build, base_sha256=base_sha256)
        async with _in_time(), self.database.read() as tx:
            blob = await weights.get(tx, sha256)
            if base_sha256 is not None and not self._decoders.has_base(base_sha256):
                build = partial(build, base=await weights.get(tx, base_sha256))
        return await asyncio.to_thread(build, blob)

    def _refuse_what_failed(self, sha256: str) -> None:
        failed_at = self._failed_at.get(sha256)
        if failed_at is not None and time.monotonic() - failed_at < RETRY_S:
            raise UnusableWeightsError("they failed a moment ago")


def _list_used(choice: Choice) -> list[str]:
    """List the digests of what a choice holds."""
    every = (choice, choice.previous)
    return [one.stamp.sha256 for one in every if one is not None and one.stamp.sha256 is not None]


@asynccontextmanager
async def _in_time() -> AsyncIterator[None]:
    """Take a database that hangs for one that is away."""
    try:
        async with asyncio.timeout(READ_S):
            yield
    except TimeoutError:
        raise NotReadyError("The database takes too long.") from None
