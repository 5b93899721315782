"""Whose weights are loaded, when, and what stands behind them."""

import asyncio
import threading
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from datetime import timedelta
from typing import Any
from uuid import uuid4

import pytest
from sqlalchemy.ext.asyncio import AsyncSession

from app.domain.errors import NotReadyError, UnknownVersionError, VersionUnavailableError
from app.live import housekeeper, shelf
from app.live import library as library_module
from app.live.breaker import TRIP_AFTER
from app.live.decoders import Decoders
from app.live.library import Library
from app.storage import users, versions
from app.storage.database import Database
from app.storage.housekeeping import Forgotten
from models.baselines import Forecaster
from models.personal import PersonalDecoder
from tests.personal_support import add_user
from tests.versions import BASE_SHA256, add_version, dump, make_net, make_personal

pytestmark = pytest.mark.asyncio
BASE = make_net()
MINE, OTHER = make_personal(BASE, 1), make_personal(BASE, 2)


class SlowDecoders(Decoders):
    """Builds decoders of certain weights only when it is let, and counts what it builds."""

    def __init__(self, *slow: bytes) -> None:
        super().__init__(BASE, base_sha256=BASE_SHA256)
        self.slow, self.built = slow, []
        self.begun, self.release = threading.Event(), threading.Event()

    def build(self, blob: bytes, **base: Any) -> Forecaster:
        self.built.append(blob)
        if blob in self.slow:
            self.begun.set()
            assert self.release.wait(10)
        return super().build(blob, **base)


async def start(database, *names: str) -> list:
    async with database.write() as tx:
        return [(await add_user(tx, name)).uuid for name in names]


async def test_nobody_waits_for_the_weights_of_somebody_else(database) -> None:
    ada, bob = await start(database, "ada", "bob")
    await add_version(database, "ada", MINE)
    await add_version(database, "bob", OTHER)
    decoders = SlowDecoders(dump(MINE))
    library = Library(database, decoders)
    slow = [asyncio.create_task(library.choose(ada, "active")) for _ in range(3)]
    await asyncio.to_thread(decoders.begun.wait, 10)
    async with asyncio.timeout(5):
        assert (await library.choose(bob, "active")).stamp.number == 1
    assert not any(task.done() for task in slow)
    decoders.release.set()
    chosen = await asyncio.gather(*slow)
    assert len({id(choice.forecaster) for choice in chosen}) == 1
    assert sorted(decoders.built) == sorted([dump(MINE), dump(OTHER)])


async def test_the_version_before_is_at_hand_as_soon_as_the_active_one_keeps_failing(
    database,
) -> None:
    (ada,) = await start(database, "ada")
    first = await add_version(database, "ada", MINE)
    second = await add_version(database, "ada", OTHER)
    library = Library(database, decoders := Decoders(BASE, base_sha256=BASE_SHA256))
    (healthy,) = (await library.follow([ada])).values()
    assert healthy.previous is None
    for _ in range(TRIP_AFTER):
        assert (await library.choose(ada, "active")).previous is None
        decoders.breaker.fail(second.sha256, "guard")
    (followed,) = (await library.follow([ada])).values()
    for choice in (followed, await library.choose(ada, "active")):
        assert choice.stamp == healthy.stamp  # streams are told of no change
        assert choice.previous is not None
        assert choice.previous.stamp.sha256 == first.sha256
        assert choice.previous.stamp.fallback == "previous_version"
        assert isinstance(choice.previous.forecaster, PersonalDecoder)
    assert (await library.choose(ada, 2)).previous is None


async def test_the_first_version_that_fails_has_only_the_base_behind_it(database) -> None:
    (ada,) = await start(database, "ada")
    only = await add_version(database, "ada", MINE)
    library = Library(database, decoders := Decoders(BASE, base_sha256=BASE_SHA256))
    for _ in range(TRIP_AFTER):
        decoders.breaker.fail(only.sha256, "guard")
    (choice,) = (await library.follow([ada])).values()
    assert (choice.stamp.number, choice.previous) == (1, None)


async def test_a_version_of_another_base_is_not_used(database) -> None:
    (ada,) = await start(database, "ada")
    await add_version(database, "ada", MINE)
    library = Library(database, Decoders(BASE, base_sha256="f" * 64))
    choice = await library.choose(ada, "active")
    assert (choice.stamp.kind, choice.stamp.fallback) == ("base", "weights_missing")
    with pytest.raises(VersionUnavailableError):
        await library.choose(ada, 1)


async def test_what_was_erased_is_not_chosen(database) -> None:
    (ada,) = await start(database, "ada")
    await add_version(database, "ada", MINE)
    library = Library(database, Decoders(BASE, base_sha256=BASE_SHA256))
    await library.choose(ada, "active")
    async with database.write() as tx:
        await users.erase(tx, "ada", actor=None, audit_key=b"audit")
    assert (await library.choose(ada, "active")).stamp.kind == "base"
    await library.follow([])
    assert not library.loaded()


async def test_who_is_erased_while_their_weights_fail_has_the_base(database, monkeypatch) -> None:
    async def find_nothing(*_: object) -> None:
        raise UnknownVersionError("There is no version 1.")

    (ada,) = await start(database, "ada")
    await add_version(database, "ada", MINE)
    monkeypatch.setattr(versions, "read_previous", find_nothing)
    library = Library(database, Decoders(BASE, base_sha256="f" * 64))
    assert (await library.choose(ada, "active")).stamp.fallback == "weights_missing"


async def test_what_streams_use_stays_however_much_that_is(database, monkeypatch) -> None:
    monkeypatch.setattr(shelf, "KEPT", 1)
    people = await start(database, "ada", "bob", "eve")
    for seed, name in enumerate(("ada", "bob", "eve")):
        await add_version(database, name, make_personal(BASE, seed))
    library = Library(database, decoders := SlowDecoders())
    for _ in range(2):
        assert len(await library.follow(people)) == 3
        for user in people:
            await library.choose(user, "active")
    assert len(decoders.built) == len(library.loaded()) == 3
    pinned = await library.choose(people[0], 1)
    await library.follow([])
    assert len(library.loaded()) == 2  # one that is held elsewhere, and one that is idle
    await library.choose(people[2], "active")
    assert (await library.choose(people[0], 1)).forecaster is pinned.forecaster
    assert len(decoders.built) <= 4


async def test_weights_that_fail_are_not_looked_into_every_second(database, monkeypatch) -> None:
    reads = []

    async def count(tx, user_uuid):
        reads.append(user_uuid)
        return await list_history(tx, user_uuid)

    list_history = versions.list_history
    (ada,) = await start(database, "ada")
    await add_version(database, "ada", MINE)
    monkeypatch.setattr(versions, "list_history", count)
    library = Library(database, Decoders(BASE, base_sha256="f" * 64))
    for _ in range(4):
        (choice,) = (await library.follow([ada])).values()
        assert choice.stamp.fallback == "weights_missing"
    assert len(reads) == 2  # why it is active, and what was before
    monkeypatch.setattr(library_module, "RETRY_S", 0.0)
    await library.follow([ada])
    assert len(reads) == 3  # it is active for the reason for which it was


class HungDatabase(Database):
    """A database that takes every question and answers none."""

    @asynccontextmanager
    async def read(self) -> AsyncIterator[AsyncSession]:
        await asyncio.sleep(60)
        async with super().read() as tx:
            yield tx


async def test_a_database_that_hangs_is_not_waited_for(settings, monkeypatch) -> None:
    monkeypatch.setattr(library_module, "READ_S", 0.1)
    monkeypatch.setattr(housekeeper, "TIDY_S", 0.1)
    monkeypatch.setattr(HungDatabase, "write", HungDatabase.read)
    database = HungDatabase.from_settings(settings)
    library = Library(database, Decoders(BASE, base_sha256=BASE_SHA256))
    keeper = housekeeper.Housekeeper(database, list, kept=timedelta(days=1))
    async with asyncio.timeout(10):
        for asked in (library.follow([uuid4()]), library.choose(uuid4(), "active")):
            with pytest.raises(NotReadyError):
                await asked
        with pytest.raises(NotReadyError):
            await library.choose(uuid4(), 1)
        assert await keeper.tidy() == Forgotten()
    await database.close()
