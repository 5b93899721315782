"""Nothing that one person's key does reads, changes or delays anything of another person's."""

import asyncio
import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import timedelta
from typing import Any
from uuid import UUID, uuid4

import httpx
import pytest
import websockets
from hypothesis import HealthCheck, Phase, given
from hypothesis import settings as configure
from hypothesis import strategies as st
from sqlalchemy import Table, select

from app.domain.access import Scope
from app.settings import Settings
from app.storage import sessions, trials
from app.storage.database import Database
from app.storage.tables import Base, ChunkRow, ClipRow, TrialRow, UserRow, WeightsRow
from tests.live_support import RealServer, serve
from tests.personal_support import (
    START,
    add_key,
    add_trial,
    add_user,
    claim,
    enqueue,
    finish,
    make_clip,
)
from tests.support import open_database, watch_person
from tests.versions import make_net, make_net_decoders

BASE = make_net()
PERSON = watch_person(1.0).round(3).tolist()
OWN, OTHER, NOBODY = "ada", "bob", "nobody"


@dataclass(frozen=True)
class World:
    """A server, Ada's key, and what Bob has: a trial, a version, a job that waits, a key."""

    server: RealServer
    client: httpx.Client
    settings: Settings
    key: str
    bob: UUID
    ids: dict[str, str]


# the server's own thread draws random numbers meanwhile, which Hypothesis takes for a strategy's
pytestmark = pytest.mark.filterwarnings("ignore:Do not use the `random` module")


@pytest.fixture
def world(settings: Settings) -> Iterator[World]:
    with serve(settings, make_net_decoders(BASE)) as server:
        server.add_user(OWN)
        key = server.add_key("predict", "record", user=OWN)["key"]
        bob, ids = asyncio.run(settle_bob(settings))
        headers = {"Authorization": f"Bearer {key}"}
        with httpx.Client(base_url=server.http, headers=headers, timeout=30) as client:
            yield World(server, client, settings, key, bob, ids)


async def settle_bob(settings: Settings) -> tuple[UUID, dict[str, str]]:
    async with open_database(settings) as database:
        async with database.write() as tx:
            bob = await add_user(tx, OTHER)
            trial = await add_trial(tx, bob, clips=2)
            await enqueue(tx, bob)
        await finish(database, await claim(database), blob=b"bobs", parent=0)
        async with database.write() as tx:
            job = await enqueue(tx, bob)
            key = (await add_key(tx, Scope.PREDICT, user_uuid=bob.uuid)).id
        await sessions.open_session(
            database, user_uuid=bob.uuid, name="robot", key_id=key, is_admin=True
        )
    return bob.uuid, {"trial": str(trial.id), "job": str(job), "key": str(key), "number": "1"}


def dump(world: World) -> list[tuple[str, Any]]:
    """Everything that is stored of Bob."""

    async def read() -> list[tuple[str, Any]]:
        database = Database.from_settings(world.settings)
        try:
            async with database.read() as tx:
                return [
                    (table.name, sorted(map(repr, (await tx.execute(query)).all())))
                    for table, query in make_queries(world.bob)
                ]
        finally:
            await database.close()

    return asyncio.run(read())


def make_queries(user: UUID) -> list[tuple[Table, Any]]:
    mine = select(TrialRow.id).where(TrialRow.user_uuid == user)
    queries: list[tuple[Table, Any]] = [
        (UserRow.__table__, select(UserRow.__table__).where(UserRow.uuid == user)),
        (ClipRow.__table__, select(ClipRow.__table__).where(ClipRow.trial_id.in_(mine))),
        (ChunkRow.__table__, select(ChunkRow.__table__).where(ChunkRow.trial_id.in_(mine))),
        (WeightsRow.__table__, select(WeightsRow.__table__)),
    ]
    return queries + [
        (table, select(table).where(table.columns["user_uuid"] == user))
        for table in Base.metadata.sorted_tables
        if "user_uuid" in table.columns
    ]


ROUTES = st.integers(0, 1000)
BODIES: dict[str, Any] = {
    "nothing": None,
    "empty": {},
    "frames": {"frames": PERSON[:15]},
    "frames of version 1": {"frames": PERSON[:15], "version": 1},
    "trial": {"label": "mine", "clips": [{"frames": PERSON}], "finetune": True},
    "user": {"id": OTHER},
    "version": {"version": 1},
    "trials": {"trials": []},
    "key": {"user": OTHER, "scopes": ["predict"]},
    "name": {"display_name": "owned"},
}
QUIET_S = 0.5
"""A pong may overtake what needs the database; nothing comes so long after it."""
CALLS = st.tuples(
    st.just("call"), ROUTES, st.sampled_from([OWN, OTHER]), st.sampled_from(sorted(BODIES))
)
STREAMS = st.tuples(
    st.just("stream"),
    st.sampled_from([OTHER, OWN]),
    st.lists(
        st.sampled_from(["resume", "start", "configure", "frame", "stop", "cancel", "clip"]),
        max_size=4,
    ),
)


@configure(
    max_examples=6,
    deadline=None,
    phases=[Phase.explicit, Phase.reuse, Phase.generate],  # making it smaller takes minutes
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(steps=st.lists(st.one_of(CALLS, CALLS, CALLS, STREAMS), min_size=6, max_size=12))
def check(world: World, steps: list[tuple[Any, ...]]) -> None:
    before = dump(world)
    for step in steps:
        if step[0] == "call":
            call_twice(world, *step[1:])
        else:
            asyncio.run(stream_twice(world, *step[1:]))
    assert dump(world) == before


def test_no_sequence_of_calls_reads_or_changes_what_is_somebody_elses(world) -> None:
    check(world)


def test_every_route_is_refused_for_somebody_else_whether_they_exist_or_not(world) -> None:
    before = dump(world)
    for route in range(len(list_routes(world))):
        for body in ("nothing", "frames"):
            call_twice(world, route, OTHER, body)
            call_twice(world, route, OWN, body)
    assert dump(world) == before


def list_routes(world: World) -> list[tuple[str, str]]:
    """Every route that needs a key."""
    return [
        (method.upper(), path)
        for path, operations in world.server.app.openapi()["paths"].items()
        for method, operation in operations.items()
        if operation["x-scope"] != "none"
    ]


def call_twice(world: World, route: int, user: str, body: str) -> None:
    """Ask for what is Bob's, and for what nobody has: the answers must be the same."""
    routes = list_routes(world)
    method, path = routes[route % len(routes)]
    foreign = any(f"{{{name}}}" in path for name in world.ids)
    if user == OWN and not foreign:
        assert call(world, method, path.replace("{user}", OWN), body)[0] < 500
        return
    existing = path.replace("{user}", user)
    missing = path.replace("{user}", NOBODY if user == OTHER else OWN)
    for name, value in world.ids.items():
        existing = existing.replace(f"{{{name}}}", value)
        missing = missing.replace(f"{{{name}}}", "7" if name == "number" else str(uuid4()))
    found = call(world, method, existing, body)
    assert found == call(world, method, missing, body), (method, path)
    is_mine = user == OWN and "/admin/" not in path
    assert found[0] in {403, 413, *((404, 422) if is_mine else ())}, (method, path)


def call(world: World, method: str, path: str, body: str) -> tuple[int, str]:
    answer = world.client.request(method, path, json=BODIES[body])
    text = answer.text
    for part in path.split("/"):
        if len(part) > 30:  # an id that the caller named itself
            text = text.replace(part, "*")
    return answer.status_code, re.sub(r"version \d+", "version *", text)


async def stream_twice(world: World, user: str, messages: list[str]) -> None:
    if user == OTHER:
        found = [await try_to_open(world, name) for name in (OTHER, NOBODY)]
        assert found[0] == found[1]
        assert found[0][0] == 4403
        return
    mine, nobodys = world.ids["trial"], str(uuid4())
    told = [await talk(world, messages, trial=trial) for trial in (mine, nobodys)]
    if "start" not in messages:  # a new recording may be called what nothing is called yet
        assert told[0] == told[1]
    assert mine not in "".join(told[0]).replace("*", "")


async def try_to_open(world: World, user: str) -> tuple[int, str]:
    async with world.server.stream(user, key=world.key, hello=False) as client:
        code, messages = await client.expect_close()
    return code, json.dumps(messages)


async def talk(world: World, messages: list[str], *, trial: str) -> list[str]:
    """Say these things on Ada's own stream, naming a trial; gives the errors."""
    number = 1 if trial == world.ids["trial"] else 7
    meant = {
        "resume": {"type": "trial.resume", "trial": trial},
        "start": {"type": "trial.start", "trial": trial},
        "configure": {"type": "configure", "version": number},
        "frame": {"type": "frame", "seq": 0, "t": 0.0, "joints": PERSON[0]},
        "stop": {"type": "trial.stop", "finetune": False},
        "cancel": {"type": "trial.cancel"},
        "clip": {"type": "clip.start"},
    }
    heard, is_answered = [], False
    async with world.server.stream(OWN, key=world.key, query="?session=robot") as client:
        for name in messages:
            await client.send(**meant[name])
        await client.send(type="ping", id=1, t=0.0)
        while True:
            try:
                message = await client.receive(QUIET_S if is_answered else 5.0)
            except TimeoutError:
                assert is_answered
                break
            except websockets.ConnectionClosed as closed:
                heard.append(str(closed.rcvd and closed.rcvd.code))
                break
            if message["type"] == "pong":
                is_answered = True
            if message["type"] == "error":
                heard.append(f"{message['code']} {message.get('detail')}")
    return [re.sub(r"version \d+", "version *", line.replace(trial, "*")) for line in heard]


CLIP = make_clip()


async def record(tx, user, times):
    """Upload so many trials, each of which asks for a job."""
    for _ in range(times):
        await trials.add(tx, user, label=None, finetune=True, clips=[CLIP])
        await enqueue(tx, user)


@pytest.mark.asyncio
async def test_whoever_asks_for_thirty_jobs_delays_nobody_by_more_than_one(database) -> None:
    async with database.write() as tx:
        ada, bob = await add_user(tx, OWN), await add_user(tx, OTHER)
        await record(tx, ada, 30)
    first = await claim(database)
    assert first.user_uuid == ada.uuid
    async with database.write() as tx:
        await record(tx, bob, 1)
        await record(tx, ada, 30)
    await finish(database, first)
    for turn in range(4):
        held = await claim(database, now=START + timedelta(seconds=turn + 1))
        assert held is not None
        assert held.user_uuid == (ada.uuid if turn % 2 else bob.uuid)
        await finish(database, held)
        async with database.write() as tx:
            await record(tx, ada, 10)
            await record(tx, bob, 1)
