"""What is asked again and again reads what it asks for, not all that there ever was."""

import asyncio
import time
from contextlib import contextmanager
from datetime import timedelta
from uuid import uuid4

import pytest
from sqlalchemy import event, text, update

from app.live.job_watch import PROGRESS_S, listen_to
from app.live.sweeper import GRACE_S, Sweeper
from app.storage.abandoned import has_abandoned, store_abandoned
from app.storage.announcements import Announcements, Topic
from app.storage.job_news import read_job_news
from app.storage.tables import TrialRow
from tests.personal_support import START, add_trial, add_user, claim, enqueue, finish

pytestmark = pytest.mark.asyncio


@contextmanager
def listen(database):
    """Collect the statements that are carried out, each with its values."""
    heard = []

    def hear(connection, cursor, statement, parameters, context, many):
        del connection, cursor, context, many
        heard.append((statement, parameters))

    engine = database._engine.sync_engine
    event.listen(engine, "before_cursor_execute", hear)
    try:
        yield heard
    finally:
        event.remove(engine, "before_cursor_execute", hear)


async def explain(database, ask):
    """Tell how a database goes about a question."""
    async with database.write() as tx:
        if not database.is_sqlite:  # which would read such small tables as a whole
            await tx.execute(text("SET LOCAL enable_seqscan = off"))
        with listen(database) as heard:
            await ask(tx)
        statement, parameters = heard[-1]
        word = "EXPLAIN QUERY PLAN" if database.is_sqlite else "EXPLAIN"
        connection = await tx.connection()
        lines = await connection.exec_driver_sql(f"{word} {statement}", parameters)
        return "\n".join(str(line[-1]) for line in lines)


@pytest.mark.parametrize("look", [has_abandoned, store_abandoned])
async def test_abandoned_recordings_are_found_without_looking_at_other_trials(database, look):
    given = {"before": START} | ({"now": START} if look is store_abandoned else {})
    plan = await explain(database, lambda tx: look(tx, **given))
    assert "ix_trials_recording" in plan
    assert "SCAN trials" not in plan


async def test_without_an_abandoned_recording_nothing_is_written(database):
    async with database.write() as tx:
        await add_trial(tx, await add_user(tx))
        await tx.execute(update(TrialRow).values(touched_at=START))  # long ago, and complete
    now = 0.0
    sweeper = Sweeper(database, abandoned_s=60.0, clock=lambda: now)
    await sweeper.sweep()
    now = GRACE_S
    with listen(database) as heard:
        assert await sweeper.sweep() == 0
    assert heard
    assert not [statement for statement, _ in heard if statement.startswith("UPDATE")]


async def test_news_of_jobs_are_found_without_looking_at_old_jobs(database):
    users, known = [uuid4(), uuid4()], [uuid4()]
    plan = await explain(database, lambda tx: read_job_news(tx, users, known=known, since=START))
    assert "ix_jobs_user_uuid_finished_at" in plan
    for way in ("ix_jobs_user_uuid_created_at_id", "SCAN jobs", "Seq Scan on jobs"):
        assert way not in plan


async def test_news_are_of_open_jobs_known_ones_and_those_that_just_ended(database):
    async with database.write() as tx:
        ada, bob = await add_user(tx), await add_user(tx, "bob")
        await add_trial(tx, ada)
        old = await enqueue(tx, ada)
    await finish(database, await claim(database))
    ended = []
    for minute in (1, 2):
        async with database.write() as tx:
            ended.append(await enqueue(tx, ada))
        held = await claim(database, now=START + timedelta(minutes=minute))
        await finish(database, held, now=START + timedelta(minutes=minute))
    async with database.write() as tx:
        waiting = await enqueue(tx, ada)
        await enqueue(tx, bob)
    async with database.read() as tx:
        since = START + timedelta(minutes=1)
        news = await read_job_news(tx, [ada.uuid], known=[], since=since)
        more = await read_job_news(tx, [ada.uuid], known=[ended[0]], since=since)
    assert [one.id for one in news] == [ended[1], waiting]
    assert news[0].metrics == {"before": [1.0], "after": [0.5]}
    assert [one.id for one in more] == [*ended, waiting]
    assert old not in {one.id for one in more}


@pytest.mark.parametrize(
    ("topic", "least", "most"),
    [(Topic.PROGRESS, 0.9 * PROGRESS_S, 5.0), (Topic.JOBS, 0.0, 0.5 * PROGRESS_S)],
)
async def test_progress_is_looked_at_once_a_second_and_the_end_at_once(topic, least, most):
    announcements = Announcements()
    wait = listen_to(announcements)()

    async def train():
        while True:
            announcements.tell([topic])
            await asyncio.sleep(0.05)

    training = asyncio.create_task(train())
    began = time.monotonic()
    await wait(10.0)
    assert least <= time.monotonic() - began < most
    training.cancel()


async def test_without_hints_a_watch_waits_as_long_as_it_would():
    wait = listen_to(Announcements())()
    for seconds in (0.1, PROGRESS_S + 0.1):
        began = time.monotonic()
        await wait(seconds)
        assert time.monotonic() - began >= 0.99 * seconds
