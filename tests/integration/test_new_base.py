"""A new base: everybody keeps what they have on the old one, until they are fitted again."""

import asyncio
import hashlib
from datetime import timedelta

import numpy as np
import pytest
import pytest_asyncio
import torch

from app.domain.jobs import JobReason, JobState
from app.live.decoders import Decoders
from app.live.library import Library
from app.personalize.promote import prepare_task
from app.storage import jobs, versions
from app.worker import setup
from app.worker.setup import ask_for_refits, store_base
from models.checkpoint import dump_checkpoint
from models.predictor import Predictor
from tests.live_support import serve
from tests.nets import TINY
from tests.personal_support import START, add_trial, add_user, claim, enqueue, finish
from tests.support import make_settings, open_database, watch_person
from tests.versions import add_version, forecast_offline, know, make_personal

pytestmark = pytest.mark.asyncio
PERSON = watch_person(3.0)


class Base:
    """A base as it is shipped: a net, its file, its name."""

    def __init__(self, seed):
        torch.manual_seed(seed)
        self.net = Predictor(config=TINY).eval().requires_grad_(requires_grad=False)
        self.blob = dump_checkpoint(self.net, {})
        self.sha256 = hashlib.sha256(self.blob).hexdigest()

    def decoders(self):
        return Decoders(self.net, base_sha256=self.sha256)

    async def add_version(self, database, user_id, seed, **options):
        """A version that was fitted on this base, and is active now."""
        personal = make_personal(self.net, seed, **options)
        return personal, await add_version(database, user_id, personal, base_sha256=self.sha256)


OLD, NEW = Base(1), Base(2)


async def list_waiting(database, user_id=None):
    async with database.read() as tx:
        page = await jobs.list_page(tx, user=user_id, state=JobState.QUEUED, after=None, limit=500)
    return page.items


@pytest_asyncio.fixture
async def ada(database):
    """Somebody with a version on the old base."""
    async with database.write() as tx:
        user = await add_user(tx)
    await store_base(database, OLD.blob)
    await OLD.add_version(database, "ada", 1)
    return user


async def test_everybody_on_another_base_is_fitted_again_and_asked_for_once(database, ada):
    async with database.write() as tx:
        for name in ("never-recorded", "without-a-version"):
            user = await add_user(tx, name)
        await add_trial(tx, user)
        await add_user(tx, "new")
    await NEW.add_version(database, "new", 2)
    assert await ask_for_refits(database, NEW.sha256) == 1
    (job,) = await list_waiting(database)
    assert (job.user, job.reason, job.requested_by) == ("ada", JobReason.NEW_BASE, None)
    assert await ask_for_refits(database, NEW.sha256) == 0
    await finish(database, await claim(database, base_sha256=NEW.sha256), blob=None)
    assert await ask_for_refits(database, NEW.sha256) == 0  # it did not win; that is that
    assert await list_waiting(database) == []


async def test_large_crowds_are_asked_for_in_batches(database, ada):
    for name in ("bob", "eve"):
        async with database.write() as tx:
            await add_user(tx, name)
        await OLD.add_version(database, name, 1)
    async with database.write() as tx:
        assert await jobs.enqueue_refits(tx, NEW.sha256, limit=2) == 2
    assert await ask_for_refits(database, NEW.sha256) == 1
    assert len(await list_waiting(database)) == 3
    assert setup.REFITS_AT_A_TIME > 1


async def test_nobody_is_forgotten_whom_somebody_else_decides_about_just_now(database, ada):
    async with database.write() as tx:
        await versions.lock_user(tx, ada.uuid)
        asking = asyncio.create_task(ask_for_refits(database, NEW.sha256))
        await asyncio.sleep(0.3)
    assert await asyncio.wait_for(asking, 10) == 1
    assert len(await list_waiting(database)) == 1


async def test_replicas_that_start_together_ask_once(database, ada):
    asked = await asyncio.gather(*(ask_for_refits(database, NEW.sha256) for _ in range(4)))
    assert sum(asked) == 1
    assert len(await list_waiting(database)) == 1


async def test_worker_with_the_old_base_leaves_the_job_to_one_with_the_new(database, ada):
    await ask_for_refits(database, NEW.sha256)
    assert await claim(database, base_sha256=OLD.sha256) is None
    held = await claim(database, base_sha256=NEW.sha256)
    assert held is not None
    later = START + timedelta(hours=1)  # the lease has run out
    assert await claim(database, base_sha256=OLD.sha256, now=later) is None
    assert (await claim(database, base_sha256=NEW.sha256, now=later)).job_id == held.job_id


async def test_base_that_is_taken_back_holds_no_job_up(database, ada):
    await ask_for_refits(database, NEW.sha256)
    await ask_for_refits(database, OLD.sha256)
    assert await claim(database, base_sha256=NEW.sha256) is None
    assert await claim(database, base_sha256=OLD.sha256) is not None


async def test_who_recorded_something_comes_before_who_is_only_fitted_again(database, ada):
    await ask_for_refits(database, NEW.sha256)
    async with database.write() as tx:
        eager = await add_user(tx, "eager")
        await add_trial(tx, eager)
        await enqueue(tx, eager)
    first = await claim(database, base_sha256=NEW.sha256)
    assert first.user_uuid == eager.uuid


async def test_trial_takes_the_job_over_that_waits(database, ada):
    await ask_for_refits(database, NEW.sha256)
    async with database.write() as tx:
        job_id = await enqueue(tx, ada)
    (job,) = await list_waiting(database)
    assert (job.id, job.reason) == (job_id, JobReason.TRIAL)
    assert await claim(database, base_sha256=OLD.sha256) is None


async def test_candidate_is_compared_with_what_is_active_on_its_own_base(database, ada):
    await ask_for_refits(database, NEW.sha256)
    held = await claim(database, base_sha256=NEW.sha256)
    async with database.read() as tx:
        task = await prepare_task(tx, held, base=NEW.blob, base_sha256=NEW.sha256, threads=1)
        active = await versions.read_active_of(tx, ada.uuid)
    assert (task.base, task.active_base, task.parent) == (NEW.blob, OLD.blob, 1)
    assert hashlib.sha256(task.active).hexdigest() == active.sha256
    async with database.read() as tx:
        task = await prepare_task(tx, held, base=OLD.blob, base_sha256=OLD.sha256, threads=1)
    assert task.active_base is None


async def test_version_runs_on_the_encoder_of_its_own_base(database, ada):
    personal, version = await OLD.add_version(
        database, "ada", 3, familiarity=know(OLD.net, PERSON[None, :15])
    )
    decoders = NEW.decoders()
    choice = await Library(database, decoders).choose(ada.uuid, "active")
    assert (choice.stamp.sha256, choice.stamp.fallback) == (version.sha256, None)
    windows = np.stack([PERSON[:15], PERSON[40:55], PERSON[60:75]])
    mixed = decoders.forecast_each(windows, [choice.forecaster, None, choice.forecaster])
    for window, made, forecaster in zip(windows, mixed, (personal, NEW.net, personal), strict=True):
        expected = forecast_offline(forecaster, window)
        np.testing.assert_allclose(made.displacement + window[-1], expected, atol=1e-5)
    assert mixed[1].share == 0


async def test_pinned_version_on_the_old_base_still_answers(database, ada):
    choice = await Library(database, NEW.decoders()).choose(ada.uuid, 1)
    assert choice.stamp.number == 1


async def test_without_its_base_a_version_steps_down_and_says_so(database, ada):
    await NEW.add_version(database, "ada", 5)
    third = Base(3)
    choice = await Library(database, third.decoders()).choose(ada.uuid, "active")
    assert choice.stamp.fallback == "previous_version"
    assert choice.stamp.number == 1


class Stream:
    """Somebody who is shown, more slowly than the times say, and every forecast of them."""

    def __init__(self, server, user):
        self.server, self.user = server, user
        self.forecasts, self.switched = [], asyncio.Event()

    async def run(self, over):
        async with self.server.stream(self.user) as client:
            await client.send(type="configure", max_age_ms=60_000)
            listening = asyncio.create_task(self._listen(client))
            seq = 0
            while not over.is_set():
                await client.frame(seq, seq / 30, PERSON[seq % 60])
                seq += 1
                await asyncio.sleep(0.05)
            listening.cancel()
            await asyncio.gather(listening, return_exceptions=True)

    async def hear(self, number):
        """Wait for so many more forecasts."""
        enough = len(self.forecasts) + number
        while len(self.forecasts) < enough:  # noqa: ASYNC110 - bounded by the caller
            await asyncio.sleep(0.05)

    async def _listen(self, client):
        while True:
            message = await client.receive(30)
            if message["type"] == "version":
                self.switched.set()
            if message["type"] == "forecast":
                self.forecasts.append(message)


async def test_new_base_under_load_keeps_every_personal_sha256(settings):
    people = ["ada", "bob", "eve"]
    fitted = {}
    async with open_database(settings) as database:
        await store_base(database, OLD.blob)
        for seed, name in enumerate(people):
            async with database.write() as tx:
                await add_user(tx, name)
            fitted[name] = await OLD.add_version(database, name, seed)
        await store_base(database, NEW.blob)
        assert await ask_for_refits(database, NEW.sha256) == len(people)
        with serve(settings, NEW.decoders()) as server:
            server.add_user("guest")
            streams = {name: Stream(server, name) for name in [*people, "guest"]}
            over = asyncio.Event()
            running = [asyncio.create_task(stream.run(over)) for stream in streams.values()]
            async with asyncio.timeout(90):
                for stream in streams.values():
                    await stream.hear(8)
                kept = {name: len(stream.forecasts) for name, stream in streams.items()}
                _, again = await NEW.add_version(database, "ada", 7)  # the re-fit of one won
                await streams["ada"].switched.wait()
                await streams["ada"].hear(5)
            over.set()
            await asyncio.gather(*running)
    for name in people:
        personal, version = fitted[name]
        mine = streams[name].forecasts[: kept[name]] if name == "ada" else streams[name].forecasts
        assert {one["version"]["sha256"] for one in mine} == {version.sha256}, name
        assert all("fallback" not in one["quality"] for one in mine)
        for one in mine[:5]:
            check_equals_offline(one, personal)
    assert {one["version"]["kind"] for one in streams["guest"].forecasts} == {"base"}
    assert streams["ada"].forecasts[-1]["version"]["sha256"] == again.sha256


def check_equals_offline(forecast, personal):
    """A forecast of a whole window is the one that its version makes on its own base."""
    newest = forecast["seq"] % 60
    if newest < 14:
        return
    expected = forecast_offline(personal, PERSON[newest - 14 : newest + 1])
    told = np.asarray(forecast["frames"], dtype=np.float64).reshape(expected.shape)
    np.testing.assert_allclose(told, expected, atol=1e-4)


async def test_base_is_registered_and_users_are_asked_for_when_a_service_starts(tmp_path):
    from app.commands import serve as command

    model = tmp_path / "new.safetensors"
    model.write_bytes(NEW.blob)
    settings = make_settings(tmp_path / "data", model=model)
    async with open_database(settings) as database:
        async with database.write() as tx:
            await add_user(tx)
        await store_base(database, OLD.blob)
        await OLD.add_version(database, "ada", 1)
        for _ in range(2):
            await command._register_base(settings)
        (job,) = await list_waiting(database)
        async with database.read() as tx:
            task_base = await setup.weights.get(tx, NEW.sha256)
    assert job.reason is JobReason.NEW_BASE
    assert task_base == NEW.blob
