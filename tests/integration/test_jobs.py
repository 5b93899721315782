"""The queue of jobs and what works on it, on both databases."""

import asyncio
from datetime import timedelta
from uuid import uuid4

import pytest
from sqlalchemy import func, select, text
from sqlalchemy.exc import IntegrityError

from app.domain.errors import JobQueuedError, UnknownJobError, UnknownUserError
from app.domain.jobs import MAX_ATTEMPTS, JobReason, JobState
from app.domain.versions import Verdict
from app.storage import jobs, leases, users
from app.storage.leases import Hold
from app.storage.results import FencedJobError
from app.storage.tables import ActivationRow, JobRow, VersionRow, WeightsRow
from tests.personal_support import (
    LEASE,
    START,
    add_trial,
    add_user,
    claim,
    enqueue,
    finish,
)

pytestmark = pytest.mark.asyncio
LATER = START + LEASE + timedelta(seconds=1)


async def add_job(database, user_id="ada"):
    async with database.write() as tx:
        user = await add_user(tx, user_id)
        trial = await add_trial(tx, user)
        return user, trial, await enqueue(tx, user)


async def get(database, job_id):
    async with database.read() as tx:
        return await jobs.get(tx, job_id)


async def count(database, table):
    async with database.read() as tx:
        return await tx.scalar(select(func.count()).select_from(table))


async def test_trials_that_arrive_meanwhile_join_the_job_that_waits(database):
    user, first, job_id = await add_job(database)
    async with database.write() as tx:
        second = await add_trial(tx, user)
        assert await enqueue(tx, user) == job_id
    held = await claim(database)
    assert (held.job_id, held.trials) == (job_id, (first.id, second.id))
    async with database.write() as tx:
        third = await add_trial(tx, user)
        assert await enqueue(tx, user) != job_id
    await finish(database, held)
    assert (await claim(database)).trials == (first.id, second.id, third.id)


async def test_one_job_of_a_user_runs_at_a_time(database):
    user, _, _ = await add_job(database)
    held = await claim(database)
    async with database.write() as tx:
        await enqueue(tx, user)
    assert await claim(database) is None
    await finish(database, held)
    assert await claim(database) is not None


@pytest.mark.parametrize("state", ["queued", "running"])
async def test_database_itself_refuses_a_second_one(database, state):
    user, _, _job_id = await add_job(database)
    if state == "running":
        await claim(database)
    with pytest.raises(IntegrityError):
        async with database.write() as tx:
            tx.add(
                JobRow(
                    user_uuid=user.uuid,
                    state=state,
                    reason=JobReason.TRIAL,
                    explicit=False,
                    fence=1,
                )
            )


async def test_explicit_list_is_never_merged(database):
    user, trial, _ = await add_job(database)
    with pytest.raises(JobQueuedError):
        async with database.write() as tx:
            await jobs.enqueue_explicit(tx, user.uuid, [trial.id], requested_by=None)
    await claim(database)
    async with database.write() as tx:
        chosen = await jobs.enqueue_explicit(tx, user.uuid, [trial.id, uuid4()], requested_by=None)
        assert await enqueue(tx, user) != chosen
    with pytest.raises(JobQueuedError):
        async with database.write() as tx:
            await jobs.enqueue_explicit(tx, user.uuid, [trial.id], requested_by=None)
    async with database.write() as tx:
        await tx.execute(text("UPDATE jobs SET state = 'failed' WHERE state = 'running'"))
    held = await claim(database)
    assert (held.job_id, held.trials) == (chosen, (trial.id,))


async def test_users_take_turns(database):
    for user_id in ("ada", "bob", "cyd"):
        await add_job(database, user_id)
    order = []
    for turn in range(6):
        held = await claim(database, now=START + timedelta(seconds=turn))
        async with database.write() as tx:
            job = await jobs.get(tx, held.job_id)
            user = await users.get(tx, job.user)
            await leases.close(
                tx,
                held,
                state=JobState.REJECTED,
                reason=JobReason.DID_NOT_WIN,
                message=None,
                now=START,
            )
            await enqueue(tx, user)
        order.append(job.user)
    assert order == ["ada", "bob", "cyd"] * 2


async def test_job_whose_worker_vanished_is_taken_over_in_place(database):
    user, _, job_id = await add_job(database)
    dead = await claim(database, owner="dead")
    async with database.write() as tx:
        await enqueue(tx, user)  # the sibling that would be in the way of a job put back
    assert await claim(database, now=START + LEASE - timedelta(seconds=1)) is None
    heir = await claim(database, now=LATER, owner="heir")
    assert (heir.job_id, heir.fence, heir.attempt) == (job_id, dead.fence + 1, 2)
    async with database.write() as tx:
        assert await leases.renew(tx, dead, lease=LEASE, now=LATER) is Hold.LOST
        assert not await leases.give_back(tx, dead, now=LATER)
        assert not await leases.fail(tx, dead, message="late", now=LATER)
    before = await count(database, WeightsRow)
    with pytest.raises(FencedJobError):
        await finish(database, dead)
    assert await count(database, WeightsRow) == before
    assert await count(database, VersionRow) == 0
    assert await finish(database, heir) is JobReason.PROMOTED


async def test_heartbeat_keeps_a_job_and_tells_progress(database):
    _, _, job_id = await add_job(database)
    held = await claim(database)
    soon = START + timedelta(seconds=20)
    async with database.write() as tx:
        hold = await leases.renew(tx, held, lease=LEASE, now=soon, progress={"step": 3})
        assert hold is Hold.HELD
    assert await claim(database, now=LATER) is None
    assert (await get(database, job_id)).progress == {"step": 3}


async def test_job_that_ends_its_workers_fails_in_the_end(database):
    _, _, job_id = await add_job(database)
    now = START
    for attempt in range(1, MAX_ATTEMPTS + 1):
        assert (await claim(database, now=now)).attempt == attempt
        now += LEASE + timedelta(seconds=1)
    assert await claim(database, now=now) is None
    job = await get(database, job_id)
    assert (job.state, job.reason) == (JobState.FAILED, JobReason.ERROR)
    assert "vanished" in job.message


async def test_failed_attempt_is_tried_again_later_with_its_error(database):
    _, _, job_id = await add_job(database)
    now = START
    for _ in range(MAX_ATTEMPTS):
        held = await claim(database, now=now)
        async with database.write() as tx:
            assert await leases.fail(tx, held, message="no memory", now=now)
        assert await claim(database, now=now) is None
        now += timedelta(minutes=10)
    job = await get(database, job_id)
    assert (job.state, job.message, job.attempt) == (JobState.FAILED, "no memory", MAX_ATTEMPTS)


async def test_worker_that_leaves_politely_costs_no_attempt(database):
    await add_job(database)
    held = await claim(database)
    async with database.write() as tx:
        assert await leases.give_back(tx, held, now=START)
    again = await claim(database)
    assert (again.job_id, again.attempt, again.fence) == (held.job_id, 1, held.fence + 1)


async def test_waiting_job_is_cancelled_at_once(database):
    _, _, job_id = await add_job(database)
    async with database.write() as tx:
        job = await jobs.cancel(tx, job_id, actor=None, now=START)
    assert (job.state, job.reason, job.finished_at) == ("cancelled", "cancelled", START)
    assert await claim(database) is None


async def test_running_job_is_cancelled_by_its_worker(database):
    _, _, job_id = await add_job(database)
    held = await claim(database)
    async with database.write() as tx:
        assert (await jobs.cancel(tx, job_id, actor=None, now=START)).cancelling
    async with database.write() as tx:
        assert await leases.look(tx, held) is Hold.CANCELLED
        assert await leases.renew(tx, held, lease=LEASE, now=START) is Hold.CANCELLED
        assert await leases.close(
            tx, held, state=JobState.CANCELLED, reason=JobReason.CANCELLED, message=None, now=START
        )
    assert (await get(database, job_id)).state == JobState.CANCELLED


@pytest.mark.parametrize("when", ["before", "after"])
async def test_job_without_a_worker_is_cancelled_all_the_same(database, when):
    _, _, job_id = await add_job(database)
    held = await claim(database)
    async with database.write() as tx:
        now = START if when == "before" else LATER
        await jobs.cancel(tx, job_id, actor=None, now=now)
    assert await claim(database, now=LATER) is None
    assert (await get(database, job_id)).state == JobState.CANCELLED
    with pytest.raises(FencedJobError):
        await finish(database, held)


async def test_job_that_waits_for_another_attempt_is_cancelled_at_once(database):
    user, _, job_id = await add_job(database)
    held = await claim(database)
    async with database.write() as tx:
        await leases.fail(tx, held, message="no memory", now=START)
        await enqueue(tx, user)
    async with database.write() as tx:
        job = await jobs.cancel(tx, job_id, actor=None, now=START)
    assert (job.state, job.finished_at) == (JobState.CANCELLED, START)
    assert await claim(database) is not None  # of the same user


async def test_attempt_that_fails_when_it_was_called_off_is_not_tried_again(database):
    _, _, job_id = await add_job(database)
    held = await claim(database)
    async with database.write() as tx:
        await jobs.cancel(tx, job_id, actor=None, now=START)
        assert await leases.fail(tx, held, message="no memory", now=START)
    assert (await get(database, job_id)).state == JobState.CANCELLED


@pytest.mark.parametrize("verdict", Verdict)
async def test_of_a_job_that_was_called_off_nothing_is_stored(database, verdict):
    _, _, job_id = await add_job(database)
    held = await claim(database)
    async with database.write() as tx:
        await jobs.cancel(tx, job_id, actor=None, now=START)
    assert await finish(database, held, verdict=verdict) is JobReason.CANCELLED
    job = await get(database, job_id)
    assert (job.state, job.reason, job.version) == ("cancelled", "cancelled", None)
    for table in (WeightsRow, VersionRow, ActivationRow):
        assert await count(database, table) == 0


async def test_cancelling_what_has_ended_changes_nothing(database):
    _, _, job_id = await add_job(database)
    await finish(database, await claim(database))
    async with database.write() as tx:
        assert (await jobs.cancel(tx, job_id, actor=None, now=START)).state == "succeeded"
    with pytest.raises(UnknownJobError):
        async with database.write() as tx:
            await jobs.cancel(tx, uuid4(), actor=None, now=START)


async def test_result_of_an_erased_user_is_discarded(database):
    await add_job(database)
    held = await claim(database)
    async with database.write() as tx:
        await users.erase(tx, "ada", actor=None, audit_key=b"audit")
    async with database.read() as tx:
        assert await leases.look(tx, held) is Hold.LOST
    with pytest.raises(UnknownUserError):
        await finish(database, held)
    for table in (WeightsRow, VersionRow, JobRow, ActivationRow):
        assert await count(database, table) == 0


async def test_too_little_data_makes_no_version(database):
    _, _, job_id = await add_job(database)
    held = await claim(database)
    reason = await finish(database, held, verdict=Verdict.TOO_LITTLE_DATA, blob=None)
    assert reason == JobReason.TOO_LITTLE_DATA
    job = await get(database, job_id)
    assert (job.state, job.reason) == (JobState.REJECTED, JobReason.TOO_LITTLE_DATA)


async def test_many_workers_and_writers_lose_no_trial_and_never_overlap(database):
    people = [(await add_job(database, f"user-{i}"))[0] for i in range(3)]
    trained: dict[str, set] = {user.id: set() for user in people}
    running: set = set()
    writing = True

    async def write(seed):
        for i in range(6):
            async with database.write() as tx:
                user = people[(seed + i) % 3]
                await add_trial(tx, user)
                await enqueue(tx, user)

    async def work(owner):
        while True:
            held = await claim(database, owner=owner)
            if held is None and not writing:
                return
            if held is None:
                await asyncio.sleep(0.005)
                continue
            assert held.user_uuid not in running
            running.add(held.user_uuid)
            await asyncio.sleep(0.002)
            running.discard(held.user_uuid)
            async with database.read() as tx:
                job = await jobs.get(tx, held.job_id)
            trained[job.user] |= set(held.trials)
            await finish(database, held, verdict=Verdict.REJECT, blob=b"x")

    workers = [asyncio.create_task(work(f"worker-{i}")) for i in range(3)]
    await asyncio.gather(write(0), write(1))
    writing = False
    await asyncio.gather(*workers)
    async with database.read() as tx:
        stored = await tx.scalar(text("SELECT count(*) FROM trials"))
        waiting = await tx.scalar(text("SELECT count(*) FROM jobs WHERE finished_at IS NULL"))
    assert (sum(map(len, trained.values())), waiting) == (stored, 0)
