"""What is too old is forgotten, what is needed stays."""

from dataclasses import replace
from datetime import timedelta

import pytest
from sqlalchemy import select, update

from app.domain.access import Scope
from app.domain.jobs import JobReason, JobState
from app.domain.streams import OpenStream, Verdict
from app.domain.versions import Verdict as Judgement
from app.live.housekeeper import Housekeeper
from app.settings import HISTORY_MIN_DAYS
from app.storage import housekeeping, idempotency, jobs, leases, sessions, versions
from app.storage.housekeeping import Forgotten, forget, mark_used
from app.storage.idempotency import Answer, Request
from app.storage.tables import IdempotencyRow, JobRow, SessionRow
from tests.personal_support import START, add_key, add_trial, add_user, claim, enqueue, finish
from tests.support import make_settings, open_database

pytestmark = pytest.mark.asyncio
KEPT = timedelta(days=90)
LATER = START + KEPT + timedelta(seconds=1)


async def tidy(database, now=LATER):
    async with database.write() as tx:
        return await forget(tx, now=now, kept=KEPT)


async def end_job(database, user, state=JobState.FAILED, now=START, **result):
    """A job that ended then; gives its id."""
    async with database.write() as tx:
        job_id = await enqueue(tx, user)
    held = await claim(database, now=now)
    if state in {JobState.SUCCEEDED, JobState.REJECTED}:
        await finish(database, held, now=now, **result)
        return job_id
    async with database.write() as tx:
        reason = JobReason.ERROR
        await leases.close(tx, held, state=state, reason=reason, message=None, now=now)
    return job_id


async def list_jobs(database, user):
    async with database.read() as tx:
        return {job.id for job in await jobs.list_of_user(tx, user.uuid)}


async def test_jobs_without_a_version_go_after_a_while(database):
    async with database.write() as tx:
        user = await add_user(tx)
        await add_trial(tx, user)
    too_little = Judgement.TOO_LITTLE_DATA
    for state, result in (
        (JobState.FAILED, {}),
        (JobState.CANCELLED, {}),
        (JobState.REJECTED, {"verdict": too_little, "blob": None}),
    ):
        await end_job(database, user, state, **result)
    made = await end_job(database, user, JobState.SUCCEEDED)
    lost = await end_job(database, user, JobState.REJECTED, verdict=Judgement.REJECT)
    recent = await end_job(database, user, now=START + timedelta(seconds=2))
    async with database.write() as tx:
        waiting = await enqueue(tx, user)
    assert await tidy(database, START + KEPT) == Forgotten()
    assert await tidy(database) == Forgotten(jobs=3)
    assert await list_jobs(database, user) == {made, lost, recent, waiting}
    async with database.read() as tx:
        assert {v.job_id for v in await versions.list_all(tx, user.uuid)} == {made, lost}


async def test_answers_go_after_their_day(database):
    async with database.write() as tx:
        user = await add_user(tx)
        key_id = (await add_key(tx, Scope.PREDICT))[0]
        request = Request(key_id, user.uuid, "trials", "a", "0" * 64)
        await idempotency.remember(tx, request, Answer(202, b"{}"), now=START)
        later = START + timedelta(hours=1)
        await idempotency.remember(tx, replace(request, token="b"), Answer(202, b"{}"), now=later)
    assert await tidy(database, START + timedelta(hours=24)) == Forgotten(answers=1)
    async with database.read() as tx:
        assert list(await tx.scalars(select(IdempotencyRow.token))) == ["b"]


async def open_streams(database, *names):
    """Open streams that were opened at the start of time."""
    async with database.write() as tx:
        user = await add_user(tx)
        key_id = (await add_key(tx, Scope.PREDICT))[0]
    opened = []
    for name in names:
        epoch = await sessions.open_session(
            database, user_uuid=user.uuid, name=name, key_id=key_id, is_admin=False
        )
        opened.append(OpenStream(user_uuid=user.uuid, key_id=key_id, session=name, epoch=epoch))
    async with database.write() as tx:
        await tx.execute(update(SessionRow).values(opened_at=START))
    return opened


async def test_names_of_sessions_go_unless_a_stream_has_them(database):
    used, unused = await open_streams(database, "used", "unused")
    async with database.write() as tx:
        await mark_used(tx, [used], now=START + timedelta(days=2))
    assert await tidy(database) == Forgotten(sessions=1)
    assert await sessions.watch(database, [used, unused]) == {unused: Verdict.FENCED}


async def test_no_other_replica_forgets_the_name_of_an_open_stream(database):
    (stream,) = await open_streams(database, "robot")
    kept = timedelta(days=HISTORY_MIN_DAYS)
    for hours in range(0, 60, 5):
        now = START + timedelta(hours=hours)
        async with database.write() as tx:
            await forget(tx, now=now, kept=kept)
        async with database.write() as tx:
            await mark_used(tx, [stream], now=now)
    assert await sessions.watch(database, [stream]) == {}


async def test_a_batch_goes_at_a_time(database):
    async with database.write() as tx:
        user = await add_user(tx)
        for _ in range(housekeeping.BATCH + 3):
            tx.add(
                JobRow(
                    user_uuid=user.uuid,
                    state=JobState.FAILED,
                    reason=JobReason.ERROR,
                    explicit=False,
                    finished_at=START,
                )
            )
    keeper = Housekeeper(database, list, kept=KEPT)
    assert await keeper.tidy() == Forgotten(jobs=housekeeping.BATCH)
    assert await keeper.tidy() == Forgotten(jobs=3)
    assert await keeper.tidy() == Forgotten()


async def test_housekeeper_marks_open_streams_and_works_by_itself(database):
    (stream,) = await open_streams(database, "robot")
    keeper = Housekeeper(database, lambda: [stream], kept=KEPT, every_s=0.01)
    keeper.start()
    try:
        for _ in range(500):
            async with database.read() as tx:
                if await tx.scalar(select(SessionRow.opened_at)) > START:
                    break
    finally:
        await keeper.stop()
    assert await sessions.watch(database, [stream]) == {}


async def test_housekeeper_outlives_a_database_that_is_away(tmp_path):
    settings = make_settings(tmp_path / "data")
    async with open_database(settings) as database:
        keeper = Housekeeper(database, list, kept=KEPT)
        await database.close()
        settings.data_dir.rename(tmp_path / "elsewhere")
        assert await keeper.tidy() == Forgotten()
