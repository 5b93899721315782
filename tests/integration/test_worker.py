"""A real worker with a real training process, and trainers that need no nets."""

import asyncio
from contextlib import asynccontextmanager

import pytest
from sqlalchemy import text
from structlog.testing import capture_logs

from app.domain.body import measure_bones
from app.domain.jobs import JobReason, JobState
from app.domain.recordings import RawFrames, unpack_frames
from app.domain.trials import ClipFlaw
from app.domain.users import Lived
from app.personalize.promote import prepare_task
from app.storage import jobs, trials, users, versions, weights
from app.worker.loop import Worker, WorkerRules
from app.worker.setup import store_base
from tests.personal_support import (
    BASE_SHA256,
    add_trial,
    add_user,
    claim,
    enqueue,
    make_clip,
    record_frames,
)

pytestmark = pytest.mark.asyncio


def make_worker(database, trainer, *, stop=None, **rules):
    given = {"owner": "test", "base": b"base", "base_sha256": BASE_SHA256, "poll_s": 0.05}
    made = WorkerRules(trainer=f"tests.trainers:{trainer}", **(given | rules))
    return Worker(database, made, stop or asyncio.Event())


async def add_job(database, user_id="ada", clips=None):
    async with database.write() as tx:
        user = await add_user(tx, user_id)
        if clips is None:
            trial = await add_trial(tx, user, clips=2)
        else:
            trial = await trials.add(tx, user, label=None, finetune=True, clips=clips)
        return user, trial, await enqueue(tx, user)


async def get(database, job_id):
    async with database.read() as tx:
        return await jobs.get(tx, job_id)


async def wait_for(database, job_id, condition):
    for _ in range(400):
        job = await get(database, job_id)
        if condition(job):
            return job
        await asyncio.sleep(0.05)
    raise AssertionError(job)


@asynccontextmanager
async def running(database, trainer, **rules):
    stop = asyncio.Event()
    task = asyncio.create_task(make_worker(database, trainer, stop=stop, **rules).run())
    try:
        yield stop
    finally:
        stop.set()
        await asyncio.wait_for(task, 20)


async def test_trial_becomes_a_version(database):
    user, trial, job_id = await add_job(database)
    assert await make_worker(database, "chatty").run_pending() == 1
    job = await get(database, job_id)
    assert (job.state, job.reason, job.version) == ("succeeded", "promoted", 1)
    assert job.message == "better"
    async with database.read() as tx:
        version = await versions.get(tx, user.uuid, 1)
        assert len(await weights.get(tx, version.sha256)) == 32
    assert (version.state, version.parent, version.base_sha256) == ("active", 0, BASE_SHA256)
    assert version.trained_on == (trial.id,)
    assert version.metrics == {"clips": 2, "trials": [str(trial.id)]}


async def test_loser_is_kept_with_its_figures(database):
    user, _, job_id = await add_job(database)
    await make_worker(database, "picky").run_pending()
    job = await get(database, job_id)
    assert (job.state, job.reason, job.version) == ("rejected", "did_not_win", 1)
    async with database.read() as tx:
        assert (await versions.read_active_of(tx, user.uuid)).number == 0
        assert (await versions.get(tx, user.uuid, 1)).metrics["after"] == [2.0]


async def test_junk_is_never_trained_on_and_named(database):
    frames = record_frames()
    still = RawFrames(t=frames.t, joints=frames.joints[:1].repeat(len(frames), axis=0))
    clips = [make_clip(0, frames=still)]
    user, trial, job_id = await add_job(database, clips=clips)
    await make_worker(database, "deadly").run_pending()
    job = await get(database, job_id)
    assert (job.state, job.reason, job.version) == ("rejected", "too_little_data", None)
    assert "same pose" in job.message
    async with database.read() as tx:
        (clip,) = (await trials.get(tx, user, trial.id)).clips
    assert clip.flaw is ClipFlaw.FROZEN


def make_stranger():
    """Clips of somebody a fifth taller."""
    frames = record_frames(seed=1)
    other = RawFrames(t=frames.t, joints=frames.joints * 1.2)
    return [make_clip(i, frames=other) for i in range(4)]


async def add_more(database, user, clips):
    async with database.write() as tx:
        trial = await trials.add(tx, user, label=None, finetune=True, clips=clips)
        await jobs.enqueue(tx, user.uuid, reason=JobReason.TRIAL, requested_by=None)
    return trial


async def test_somebody_else_is_left_out_of_training(database):
    clips = [make_clip(i, frames=record_frames(seed=1)) for i in range(4)]
    user, first, _ = await add_job(database, clips=clips)
    second = await add_more(database, user, clips)
    strange = await add_more(database, user, make_stranger())
    await make_worker(database, "quick").run_pending()
    async with database.read() as tx:
        version = await versions.get(tx, user.uuid, 1)
        trained_on = version.metrics["trials"]
        assert version.trained_on == (first.id, second.id)
        found = {clip.flaw for clip in (await trials.get(tx, user, strange.id)).clips}
    assert trained_on == sorted([str(first.id), str(second.id)])
    assert found == {ClipFlaw.NOT_THIS_PERSON}
    for _ in range(2):  # now most trials show the other body
        await add_more(database, user, make_stranger())
    await make_worker(database, "quick").run_pending()
    async with database.read() as tx:
        found = {
            trial.id: {clip.flaw for clip in (await trials.get(tx, user, trial.id)).clips}
            for trial in (first, second, strange)
        }
    assert found[strange.id] == {None}
    assert found[first.id] == found[second.id] == {ClipFlaw.NOT_THIS_PERSON}


async def test_a_trial_that_cannot_be_trained_on_changes_nothing(database):
    user, _, _ = await add_job(database, clips=[make_clip(i) for i in range(3)])
    worker = make_worker(database, "quick")
    await worker.run_pending()
    frames = record_frames()
    frozen = RawFrames(t=frames.t, joints=frames.joints[:1].repeat(len(frames), 0))
    await add_more(database, user, [make_clip(i, frames=frozen) for i in range(3)])
    await worker.run_pending()
    async with database.read() as tx:
        assert (await versions.read_active_of(tx, user.uuid)).number == 1
        job = (await jobs.list_of_user(tx, user.uuid))[-1]
    assert (job.state, job.reason) == (JobState.REJECTED, JobReason.DID_NOT_WIN)
    assert "the active version stays" in job.message
    assert "same pose" in job.message


async def test_one_trial_against_one_leaves_nobodys_weights_active(database):
    user, first, _ = await add_job(database, clips=make_stranger())
    worker = make_worker(database, "quick")
    await worker.run_pending()
    async with database.read() as tx:
        assert (await versions.read_active_of(tx, user.uuid)).number == 1
    clips = [make_clip(i, frames=record_frames(seed=1)) for i in range(4)]
    second = await add_more(database, user, clips)
    await worker.run_pending()
    async with database.read() as tx:
        assert (await versions.read_active_of(tx, user.uuid)).number == 0
        last = (await versions.list_history(tx, user.uuid))[-1]
    assert last.kind == "withdrawn"
    third = await add_more(database, user, clips)
    await worker.run_pending()
    async with database.read() as tx:
        active = await versions.read_active_of(tx, user.uuid)
        trained_on = (await versions.get(tx, user.uuid, active.number)).metrics["trials"]
    assert active.number == 2
    assert trained_on == sorted([str(second.id), str(third.id)])
    assert str(first.id) not in trained_on


@pytest.mark.parametrize("lived", [0, 1])
async def test_who_was_seen_live_decides_between_one_trial_and_another(database, lived):
    clips = [make_stranger(), [make_clip(i, frames=record_frames(seed=1)) for i in range(4)]]
    user, first, _ = await add_job(database, clips=clips[0])
    worker = make_worker(database, "quick")
    await worker.run_pending()
    async with database.write() as tx:
        await users.note_lived(tx, user.uuid, Lived(measure(clips[lived]), 30.0))
    second = await add_more(database, user, clips[1])
    await worker.run_pending()
    async with database.read() as tx:
        active = await versions.read_active_of(tx, user.uuid)
        trained_on = (await versions.get(tx, user.uuid, active.number)).metrics["trials"]
        flaws = [
            {clip.flaw for clip in (await trials.get(tx, user, trial.id)).clips}
            for trial in (first, second)
        ]
    assert trained_on == [str((first, second)[lived].id)]
    assert flaws[lived] == {None}
    assert flaws[1 - lived] == {ClipFlaw.NOT_THIS_PERSON}


def measure(clips):
    """The bones of whoever is in clips."""
    return tuple(measure_bones(unpack_frames([clips[0].payload]).joints).tolist())


@pytest.mark.parametrize(("seconds", "counts"), [(9.0, False), (10.0, True)])
async def test_a_body_that_was_hardly_seen_has_no_voice(database, seconds, counts):
    user, _, _ = await add_job(database)
    async with database.write() as tx:
        await users.note_lived(tx, user.uuid, Lived((0.5,) * 8, seconds))
    held = await claim(database)
    async with database.read() as tx:
        task = await prepare_task(tx, held, base=b"base", base_sha256=BASE_SHA256, threads=1)
    assert task.lived == ([0.5] * 8 if counts else None)


async def test_progress_is_told_and_cancelling_takes_a_second(database):
    _, _, job_id = await add_job(database)
    async with running(database, "slow"):
        await wait_for(database, job_id, lambda job: (job.progress or {}).get("step", 0) > 1)
        async with database.write() as tx:
            job = await jobs.get(tx, job_id)
            await jobs.cancel(tx, job_id, actor=None, now=job.started_at)
        began = asyncio.get_running_loop().time()
        job = await wait_for(database, job_id, lambda job: job.state.is_final)
        assert asyncio.get_running_loop().time() - began < 1.5
    assert (job.state, job.reason) == (JobState.CANCELLED, JobReason.CANCELLED)


async def test_worker_that_is_stopped_gives_its_job_to_the_next(database):
    _, _, job_id = await add_job(database)
    async with running(database, "slow"):
        await wait_for(database, job_id, lambda job: job.progress is not None)
    assert (await get(database, job_id)).state == "running"
    assert await make_worker(database, "quick").run_pending() == 1
    job = await get(database, job_id)
    assert (job.state, job.attempt) == ("succeeded", 1)


@pytest.mark.parametrize(
    ("trainer", "word"), [("broken", "not finite"), ("deadly", "signal 9"), ("nowhere", "status 1")]
)
async def test_failed_attempt_waits_for_the_next_one(sqlite_database, trainer, word):
    _, _, job_id = await add_job(sqlite_database)
    assert await make_worker(sqlite_database, trainer).run_pending() == 1
    job = await get(sqlite_database, job_id)
    assert (job.state, job.attempt) == ("running", 1)
    assert word in job.message
    async with sqlite_database.write() as tx:
        await tx.execute(text("UPDATE jobs SET lease_until = created_at"))
    assert await make_worker(sqlite_database, "quick").run_pending() == 1
    assert (await get(sqlite_database, job_id)).state == "succeeded"


async def test_training_that_takes_too_long_is_ended(database):
    _, _, job_id = await add_job(database)
    await make_worker(database, "slow", timeout_s=0.5).run_pending()
    assert "longer than 0.5 s" in (await get(database, job_id)).message


async def test_heartbeat_outlives_the_lease(database):
    _, _, job_id = await add_job(database)
    async with running(database, "slow", lease_s=1.0, heartbeat_s=0.3):
        await wait_for(database, job_id, lambda job: job.progress is not None)
        await asyncio.sleep(1.5)
        assert await make_worker(database, "quick").run_pending() == 0


async def test_job_that_was_lost_is_let_go(database):
    _, _, job_id = await add_job(database)
    async with running(database, "slow") as stop:
        await wait_for(database, job_id, lambda job: job.progress is not None)
        async with database.write() as tx:
            await tx.execute(text("UPDATE jobs SET fence = fence + 1, state = 'failed'"))
        await asyncio.sleep(1.0)
        stop.set()
    assert (await get(database, job_id)).state == "failed"


async def test_user_erased_during_a_job_leaves_nothing(database):
    _, _, job_id = await add_job(database)
    async with running(database, "slow"):
        await wait_for(database, job_id, lambda job: job.progress is not None)
        with capture_logs() as logs:
            async with database.write() as tx:
                await users.erase(tx, "ada", actor=None, audit_key=b"audit")
            await asyncio.sleep(1.0)
            await add_job(database, "bob")  # the worker is there for the next one
            async with database.read() as tx:
                (job,) = (await jobs.list_page(tx, after=None, limit=5)).items
            await wait_for(database, job.id, lambda job: job.progress is not None)
    (told,) = [line for line in logs if line.get("job") == str(job_id)]
    assert told["event"] == "job no longer ours"
    assert "its user was erased" in told["why"]


async def test_base_is_stored_once(database):
    rules = WorkerRules(owner="test", base=b"base", base_sha256="wrong on purpose")
    for _ in range(2):
        await store_base(database, rules.base)
    async with database.read() as tx:
        assert await tx.scalar(text("SELECT count(*) FROM weights WHERE kind = 'base'")) == 1
