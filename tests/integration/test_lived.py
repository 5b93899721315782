"""Whose body streams see is stored, follows what is seen, and goes with the user."""

import asyncio
import io
import json
import zipfile

import numpy as np
import pytest

from app.domain.body import measure_bones
from app.domain.users import Lived
from app.live import witness as witnesses
from app.live.library import Library
from app.live.witness import Witness
from app.storage import users
from models.data.synthetic import SyntheticPerson
from tests.live_support import serve
from tests.personal_support import add_user
from tests.versions import add_version, make_net, make_net_decoders, make_personal

PERSON = SyntheticPerson(1).record("walk", 8.0).astype(np.float64)
BONES = tuple(np.linspace(-1.5, -0.5, 8).tolist())


async def read(database, user_uuid):
    async with database.read() as tx:
        return await users.read_lived(tx, user_uuid)


async def note(database, user_uuid, lived):
    async with database.write() as tx:
        await users.note_lived(tx, user_uuid, lived)


@pytest.mark.asyncio
async def test_what_is_seen_is_blended_by_seconds(database):
    async with database.write() as tx:
        user = await add_user(tx)
    assert await read(database, user.uuid) is None
    await note(database, user.uuid, Lived((0.0,) * 8, 30.0))
    await asyncio.gather(
        *(note(database, user.uuid, Lived((1.0,) * 8, 10.0)) for _ in range(3))
    )  # streams of one user, on any replica
    lived = await read(database, user.uuid)
    assert lived.seconds == 60
    assert lived.bones == pytest.approx((0.5,) * 8)


@pytest.mark.asyncio
async def test_of_an_erased_user_nothing_is_kept(database):
    async with database.write() as tx:
        user = await add_user(tx)
        await users.erase(tx, "ada", actor=None, audit_key=b"key")
    await note(database, user.uuid, Lived(BONES, 30.0))
    assert await read(database, user.uuid) is None


def test_a_stream_leaves_what_it_saw_and_the_export_shows_it(settings):
    async def show(server):
        async with server.stream() as client:
            for seq in range(220):
                await client.frame(seq, seq / 30, PERSON[seq])
                if seq % 10 == 0:
                    await asyncio.sleep(0.01)
            await client.send(type="ping", id=1, t=0.0)
            await client.expect("pong")

    async def wait(server):
        for _ in range(100):
            archive = server.call("GET", "/v1/users/ada/export").content
            with zipfile.ZipFile(io.BytesIO(archive)) as files:
                seen = json.loads(files.read("body.json"))["seen_live"]
            if seen is not None:
                return seen
            await asyncio.sleep(0.05)
        return None

    with serve(settings) as server:
        server.add_user()
        asyncio.run(show(server))
        seen = asyncio.run(wait(server))
    assert 5 <= seen["seconds"] <= 8
    np.testing.assert_allclose(seen["bones"], measure_bones(PERSON), atol=0.02)


class Watcher:
    """A stream that has seen somebody."""

    def __init__(self, stream):
        self.stream, self.taken = stream, 0

    def take_lived(self):
        self.taken += 1
        return Lived(BONES, 5.0)


class Stream:
    """As much of a stream as the witness needs."""

    def __init__(self, user_uuid):
        self.user_uuid = user_uuid


@pytest.mark.asyncio
async def test_open_streams_are_asked_again_and_again(sqlite_database):
    async with sqlite_database.write() as tx:
        user = await add_user(tx)
    witness = Witness(sqlite_database, lambda: [Watcher(Stream(user.uuid))], every_s=0.02)
    witness.start()
    for _ in range(100):
        await asyncio.sleep(0.02)
        lived = await read(sqlite_database, user.uuid)
        if lived is not None and lived.seconds > 5:
            break
    await witness.stop()
    assert lived.seconds > 5


@pytest.mark.asyncio
async def test_what_many_streams_saw_is_stored_at_once(database, monkeypatch):
    async with database.write() as tx:
        people = [await add_user(tx, f"user-{i}") for i in range(witnesses.BATCH + 2)]
    watchers = [Watcher(Stream(user.uuid)) for user in [*people, people[0]]]
    opened, write = [], database.write

    def count():
        opened.append(write())
        return opened[-1]

    monkeypatch.setattr(database, "write", count)
    await Witness(database, lambda: watchers).ask()
    assert len(opened) == 2
    assert [watcher.taken for watcher in watchers] == [1] * len(watchers)
    seconds = [(await read(database, user.uuid)).seconds for user in people]
    assert seconds == [10.0] + [5.0] * (len(people) - 1)


@pytest.mark.asyncio
async def test_a_body_that_is_not_finite_is_nobodys(database):
    async with database.write() as tx:
        ada, bob = await add_user(tx), await add_user(tx, "bob")
        seen = {ada.uuid: Lived((*BONES[:7], float("nan")), 5.0), bob.uuid: Lived(BONES, 5.0)}
        await users.note_all_lived(tx, seen)
    assert await read(database, ada.uuid) is None
    assert (await read(database, bob.uuid)).seconds == 5


@pytest.mark.asyncio
@pytest.mark.parametrize(
    ("given", "found"),
    [
        (list(BONES), BONES),
        (None, None),
        (list(BONES)[:7], None),
        ([*BONES[:7], float("inf")], None),
        ("bones", None),
    ],
)
async def test_a_version_brings_the_bones_of_its_person(sqlite_database, given, found):
    base = make_net()
    async with sqlite_database.write() as tx:
        user = await add_user(tx)
    described = {} if given is None else {"bones": given}
    await add_version(sqlite_database, "ada", make_personal(base, 1, **described))
    library = Library(sqlite_database, make_net_decoders(base))
    for requested in ("active", 1):
        assert (await library.choose(user.uuid, requested)).bones == found
