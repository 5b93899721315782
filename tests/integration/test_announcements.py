"""Hints between processes, through a Redis of these tests that is killed and started again."""

import asyncio
import shutil
import signal
import socket
import subprocess
import time
from contextlib import asynccontextmanager
from uuid import UUID

import pytest
import pytest_asyncio

from app.domain.access import Scope
from app.domain.errors import StartError
from app.domain.jobs import JobState
from app.storage import announcements, keys, users, versions
from app.storage.announcements import Announcements, Topic, announce
from tests.integration.test_worker import add_job, running, wait_for
from tests.live_support import serve
from tests.personal_support import add_key, add_trial, add_user, claim, enqueue, finish
from tests.support import make_settings, open_database
from tests.versions import add_version, make_net, make_net_decoders, make_personal

pytestmark = pytest.mark.asyncio
NEVER_S = 30.0
NET = make_net()


class OwnRedis:
    """A redis-server on a free port."""

    def __init__(self) -> None:
        with socket.create_server(("127.0.0.1", 0)) as listener:
            self.port = listener.getsockname()[1]
        self.url = f"redis://127.0.0.1:{self.port}/0"
        self.process = None

    def start(self) -> None:
        arguments = ["--port", str(self.port), "--bind", "127.0.0.1", "--save", ""]
        self.process = subprocess.Popen(
            ["redis-server", *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        for _ in range(200):
            try:
                socket.create_connection(("127.0.0.1", self.port), timeout=1).close()
            except OSError:
                time.sleep(0.02)
            else:
                return
        raise AssertionError("redis-server did not start")

    def end(self, how=signal.SIGKILL) -> None:
        if self.process is not None:
            self.process.send_signal(how)
            self.process.wait(10)
        self.process = None


@pytest.fixture
def redis():
    if shutil.which("redis-server") is None:
        pytest.skip("no redis-server on this machine")
    own = OwnRedis()
    own.start()
    yield own
    own.end()


@asynccontextmanager
async def listening(url):
    opened = Announcements(url)
    opened.start()
    try:
        yield opened
    finally:
        await opened.close()


async def until(condition, within_s=10.0):
    async with asyncio.timeout(within_s):
        while not condition():  # noqa: ASYNC110 - there is no event for it
            await asyncio.sleep(0.01)


async def hears(ear, within_s):
    """Whether a hint came before the time was over."""
    began = time.monotonic()
    await ear.wait(within_s)
    return time.monotonic() - began < within_s


async def drain_first_hint(ear):
    """Whoever begins to listen looks once, as hints may have been missed."""
    assert await hears(ear, 5.0)


@pytest_asyncio.fixture
async def pair(redis):
    """Two processes' ends: one that tells and one that listens."""
    async with listening(redis.url) as teller, listening(redis.url) as listener:
        await until(lambda: teller.state == listener.state == "on")
        yield teller, listener


async def test_hint_reaches_another_process_at_once(pair):
    teller, listener = pair
    ear = listener.listen(Topic.JOBS)
    teller.tell({Topic.JOBS})
    assert await hears(ear, 5.0)


async def test_hint_on_another_topic_wakes_nobody(pair):
    teller, listener = pair
    ear = listener.listen(Topic.STREAMS)
    teller.tell({Topic.JOBS})
    assert not await hears(ear, 0.2)


async def test_nonsense_on_the_channels_does_no_harm(pair, redis):
    _, listener = pair
    ear = listener.listen(Topic.JOBS)
    client = announcements._make_client(redis.url)
    await client.publish("kinecast:jobs", b"\x00" * 100_000)
    assert await hears(ear, 5.0)
    await client.publish("kinecast:nothing", b"")
    await client.aclose()
    assert listener.state == "on"


async def test_redis_that_dies_and_comes_back_is_used_again(pair, redis):
    teller, listener = pair
    ear = listener.listen(Topic.JOBS)
    redis.end()
    await until(lambda: listener.state == "away")
    teller.tell({Topic.JOBS})  # goes nowhere, and does no harm
    assert not await hears(ear, 0.2)
    redis.start()
    await until(lambda: listener.state == teller.state == "on")
    await drain_first_hint(ear)
    teller.tell({Topic.JOBS})
    assert await hears(ear, 5.0)


async def test_redis_that_hangs_is_noticed(redis):
    other = Announcements(redis.url, silence_s=0.1)
    other.start()
    await until(lambda: other.state == "on")
    redis.process.send_signal(signal.SIGSTOP)
    try:
        await until(lambda: other.state == "away")
        began = time.monotonic()
        other.tell({Topic.JOBS})
        assert time.monotonic() - began < 0.1
        await other.close()
    finally:
        redis.process.send_signal(signal.SIGCONT)


async def test_without_redis_hints_stay_in_the_process():
    async with listening(None) as alone:
        ear = alone.listen(Topic.JOBS, Topic.PROGRESS)
        assert alone.state == "off"
        assert not await hears(ear, 0.05)
        alone.tell({Topic.PROGRESS})
        assert await hears(ear, 5.0)


async def test_hint_that_comes_between_two_waits_counts():
    async with listening(None) as alone:
        ear = alone.listen(Topic.JOBS)
        alone.tell({Topic.JOBS})
        assert await hears(ear, 5.0)
        assert not await hears(ear, 0.05)


@pytest.mark.parametrize("url", ["localhost", "http://localhost:6379", "redis://host:port/0"])
async def test_address_that_is_none_is_one_line(url):
    with pytest.raises(StartError, match="KINECAST_REDIS_URL"):
        Announcements(url)


async def test_address_is_told_nowhere(capsys):
    async with listening("redis://:a-secret@127.0.0.1:1/0") as away:
        await asyncio.sleep(0.3)
        assert away.state == "away"
    assert "a-secret" not in "".join(capsys.readouterr())


async def announce_and_fail(database):
    async with database.write() as tx:
        announce(tx, Topic.JOBS)
        raise ZeroDivisionError


async def test_only_what_is_stored_is_announced(database):
    ear = database.announcements.listen(Topic.JOBS)
    with pytest.raises(ZeroDivisionError):
        await announce_and_fail(database)
    assert not await hears(ear, 0.05)
    async with database.write() as tx:
        announce(tx, Topic.JOBS)
        assert not ear.rung.is_set()
    assert ear.rung.is_set()


async def heard_by(database, topic, change):
    """Whether a change is announced on a topic."""
    ear = database.announcements.listen(topic)
    async with database.write() as tx:
        await change(tx)
    return ear.rung.is_set()


async def test_what_streams_look_for_is_announced(database):
    async with database.write() as tx:
        ada = await add_user(tx)
        await add_trial(tx, ada)
        await enqueue(tx, ada)
        key = await add_key(tx, Scope.PREDICT)
    ear = database.announcements.listen(Topic.STREAMS)
    await finish(database, await claim(database))
    assert ear.rung.is_set()

    async def promote(tx):
        await versions.promote(tx, ada.uuid, 0, expected=None, base_sha256="", actor=None)

    async def roll_back(tx):
        await versions.roll_back(tx, ada.uuid, expected=None, base_sha256="", actor=None)

    async def revoke(tx):
        await keys.revoke(tx, key[0], actor=None)

    async def erase(tx):
        await users.erase(tx, "ada", actor=None, audit_key=b"k" * 32)

    for change in (promote, roll_back, revoke, erase):
        assert await heard_by(database, Topic.STREAMS, change), change


async def test_worker_far_away_starts_a_job_long_before_it_polls(redis, settings):
    shared = settings.model_copy(update={"redis_url": redis.url})
    async with open_database(shared) as near, open_database(shared) as far:
        far.announcements.start()
        await until(lambda: far.announcements.state == "on")
        async with running(far, "quick", poll_s=NEVER_S):
            await asyncio.sleep(0.2)  # it has looked, and found nothing
            _, _, job_id = await add_job(near)
            await wait_for(near, job_id, lambda job: job.state is JobState.SUCCEEDED)


async def test_replica_far_away_sees_news_long_before_it_looks(redis, settings):
    lazy = settings.model_copy(update={"redis_url": redis.url, "watch_s": NEVER_S})
    with serve(lazy, make_net_decoders(NET)) as replica:
        replica.add_user()
        key = replica.add_key("predict")
        await until(lambda: replica.call("GET", "/readyz").json()["hints"] == "on")
        async with open_database(lazy) as near, replica.stream(key=key["key"]) as client:
            version = await add_version(near, "ada", make_personal(NET, 1))
            told = await client.expect("version", within_s=10)
            assert told["version"]["number"] == version.number
            async with near.write() as tx:
                await keys.revoke(tx, UUID(key["id"]), actor=None)
            assert (await client.expect_close(within_s=10))[0] == 4401


async def test_nothing_is_lost_when_redis_dies(redis, tmp_path):
    settings = make_settings(tmp_path, redis_url=redis.url)
    async with open_database(settings) as near, open_database(settings) as far:
        far.announcements.start()
        await until(lambda: far.announcements.state == "on")
        redis.end()
        async with running(far, "quick", poll_s=0.2):
            _, _, job_id = await add_job(near)
            await wait_for(near, job_id, lambda job: job.state is JobState.SUCCEEDED)
