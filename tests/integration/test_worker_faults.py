"""One representative of each fault of `make faults`: a kill, an outage, a full disk."""

import asyncio
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import pytest
from sqlalchemy import event, text

from app.domain.errors import NotReadyError
from app.storage import versions
from tests.conftest import ROOT
from tests.integration.test_trials_api import upload
from tests.integration.test_worker import add_job, get, make_worker, running, wait_for
from tests.outage import cuttable
from tests.support import open_database, watch_person

pytestmark = pytest.mark.asyncio

MOST_PAGES = 1_073_741_823
"""Of an SQLite file that nothing holds back."""


async def expect_one_version(database, user, job_id, *, attempt):
    job = await get(database, job_id)
    assert (job.state, job.attempt, job.version) == ("succeeded", attempt, 1)
    async with database.read() as tx:
        (version,) = await versions.list_all(tx, user.uuid)
        assert (await versions.read_active_of(tx, user.uuid)).sha256 == version.sha256


async def test_a_job_outlives_a_database_that_goes_away(settings):
    with cuttable(settings) as (own, outage):
        async with open_database(own) as database:
            user, _, job_id = await add_job(database)
            async with running(database, "brief", heartbeat_s=0.2):
                await wait_for(database, job_id, lambda job: job.progress is not None)
                with outage:
                    await asyncio.sleep(1.2)  # by then there is a result that cannot be stored
                await wait_for(database, job_id, lambda job: job.state.is_final)
            await expect_one_version(database, user, job_id, attempt=1)


async def test_a_result_that_cannot_be_stored_fails_its_attempt_and_holds_nobody_up(database):
    ada, _, job_id = await add_job(database)
    await add_job(database, "bob")
    assert await asyncio.wait_for(make_worker(database, "unspeakable").run_pending(), 30) == 2
    if database.is_sqlite:  # which keeps any text
        await expect_one_version(database, ada, job_id, attempt=1)
        return
    job = await get(database, job_id)
    assert (job.state, job.attempt) == ("running", 1)
    assert job.message == "The database refuses a statement (DataError)."
    async with database.write() as tx:
        assert await versions.list_all(tx, ada.uuid) == []
        await tx.execute(text("UPDATE jobs SET lease_until = created_at"))
    assert await make_worker(database, "quick").run_pending() == 2
    await expect_one_version(database, ada, job_id, attempt=2)


async def test_figures_that_are_no_numbers_are_stored_as_none(database):
    user, _, job_id = await add_job(database)
    async with running(database, "infinite", heartbeat_s=0.1):
        told = await wait_for(database, job_id, lambda job: "loss" in (job.progress or {}))
        await wait_for(database, job_id, lambda job: job.state.is_final)
    assert told.progress == {"step": 1, "loss": None}
    await expect_one_version(database, user, job_id, attempt=1)
    async with database.read() as tx:
        (version,) = await versions.list_all(tx, user.uuid)
    assert version.metrics["before"] == [1.0, None]
    assert version.metrics["deep"] == {"after": [None, 0.5]}


class Disk:
    """A disk that can be full: no page more than there are, so that SQLite says so.

    It listens from the beginning and to the end, because listeners must not change while a
    connection is on its way to the worker.
    """

    def __init__(self, database) -> None:
        self._database, self._most_pages = database, MOST_PAGES
        event.listen(database._engine.sync_engine.pool, "checkout", self._limit)

    def _limit(self, connection, record, proxy) -> None:
        del record, proxy
        cursor = connection.cursor()
        cursor.execute(f"PRAGMA max_page_count = {self._most_pages}")
        cursor.close()

    @contextmanager
    def full(self) -> Iterator[None]:
        self._most_pages = 1  # it takes the number of pages there are
        try:
            yield
        finally:
            self._most_pages = MOST_PAGES

    async def fill_pages(self) -> None:
        """Use up the pages that are there and empty."""
        async with self._database.write() as tx:
            await tx.execute(text("CREATE TABLE ballast (x BLOB)"))
        with self.full(), suppress(NotReadyError):
            while True:
                async with self._database.write() as tx:
                    await tx.execute(text("INSERT INTO ballast VALUES (zeroblob(3000))"))


async def test_a_result_waits_until_there_is_space_for_it(sqlite_database):
    database, disk = sqlite_database, Disk(sqlite_database)
    user, _, job_id = await add_job(database)
    async with running(database, "bulky"):
        await wait_for(database, job_id, lambda job: job.progress is not None)
        await disk.fill_pages()
        with disk.full():
            await asyncio.sleep(1.2)
            job = await get(database, job_id)
            async with database.read() as tx:
                assert await versions.list_all(tx, user.uuid) == []
        assert job.state == "running"
        await wait_for(database, job_id, lambda job: job.state.is_final)
    await expect_one_version(database, user, job_id, attempt=1)


MORTAL = """
import asyncio, sys
from app.settings import load_settings
from app.storage.database import Database
from app.worker.loop import Worker, WorkerRules

async def main(data_dir):
    database = Database.from_settings(load_settings(data_dir=data_dir))
    rules = WorkerRules("mortal", b"base", "0" * 64, trainer="tests.trainers:slow", lease_s=1.0,
                        heartbeat_s=0.3, poll_s=0.05)
    await Worker(database, rules, asyncio.Event()).run()

asyncio.run(main(sys.argv[1]))
"""


@pytest.fixture
def mortal(sqlite_settings):
    """A worker in a process of its own, which may be killed."""
    process = subprocess.Popen(
        [sys.executable, "-c", MORTAL, str(sqlite_settings.data_dir)],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait(10)


def find_children(pid: int) -> list[int]:
    listed = subprocess.run(
        ["ps", "-o", "pid=", "--ppid", str(pid)], capture_output=True, text=True, check=False
    )
    return [int(line) for line in listed.stdout.split()]


def is_alive(pid: int) -> bool:
    status = subprocess.run(
        ["ps", "-o", "stat=", "-p", str(pid)], capture_output=True, text=True, check=False
    )
    return bool(status.stdout.strip()) and not status.stdout.startswith("Z")


async def test_the_job_of_a_killed_worker_is_done_once_by_the_next(sqlite_database, mortal):
    database = sqlite_database
    user, _, job_id = await add_job(database)
    await wait_for(database, job_id, lambda job: job.progress is not None)
    (trainer,) = find_children(mortal.pid)
    mortal.kill()
    mortal.wait(10)
    async with running(database, "quick"):
        await wait_for(database, job_id, lambda job: job.state.is_final)
    await expect_one_version(database, user, job_id, attempt=2)
    for _ in range(50):
        if not is_alive(trainer):
            return
        await asyncio.sleep(0.1)
    raise AssertionError("the training process outlived its worker")


async def test_what_cannot_be_stored_is_not_accepted_and_forecasts_go_on(sqlite_service):
    service = sqlite_service
    await service.add_user()
    disk = Disk(service.database)
    await disk.fill_pages()
    clip = {"frames": watch_person(2.0).round(4).tolist(), "action": "wave"}
    with disk.full():
        refused = await upload(service, clip)
        assert (refused.status_code, refused.json()["code"]) == (503, "not_ready")
        seen = {"frames": watch_person(0.5).tolist()}
        answer = await service.call("POST", "/v1/users/ada/forecast", json=seen)
        assert (answer.status_code, answer.json()["version"]["number"]) == (200, 0)
    assert (await upload(service, clip)).status_code == 202
    (stored,) = (await service.call("GET", "/v1/users/ada/trials")).json()["items"]
    assert stored["frames"] == 60
