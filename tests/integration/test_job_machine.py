"""Any order of enqueue, claim, crash, expire, cancel and finish keeps the promises of the queue."""

import asyncio
from datetime import timedelta

import hypothesis.strategies as st
from hypothesis import HealthCheck
from hypothesis import settings as limits
from hypothesis.stateful import (
    RuleBasedStateMachine,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)
from sqlalchemy import delete, select

from app.domain.jobs import JobReason, JobState
from app.domain.versions import Verdict
from app.storage import jobs, leases, results, trials
from app.storage.database import Database
from app.storage.leases import Hold
from app.storage.migrate import upgrade
from app.storage.results import FencedJobError
from app.storage.tables import JobRow, TrialRow, UserRow, VersionRow
from tests.personal_support import LEASE, START, add_user, enqueue, make_result

USERS = 3
picks = st.integers(0, 7)


class JobMachine(RuleBasedStateMachine):
    """Users who record, and workers of which any may die at any time."""

    runner: asyncio.Runner
    database: Database

    def __init__(self):
        super().__init__()
        self.now = START
        self.claims = []  # every claim ever made, dead ones too
        self.fences = {}
        self.recorded = {}
        self.covered = set()
        self.people = self.run(self._start())

    def run(self, work):
        return self.runner.run(work)

    async def _start(self):
        async with self.database.write() as tx:
            await tx.execute(delete(UserRow))
            return [await add_user(tx, f"user-{i}") for i in range(USERS)]

    @rule(pick=st.integers(0, USERS - 1))
    def record(self, pick):
        async def work():
            async with self.database.write() as tx:
                user = self.people[pick]
                trial = await trials.add(tx, user, label=None, finetune=True, clips=[])
                self.recorded[trial.id] = await enqueue(tx, user)

        self.run(work())

    @rule(seconds=st.sampled_from([1, 10, 31]))
    def wait(self, seconds):
        self.now += timedelta(seconds=seconds)

    @rule()
    def claim(self):
        async def work():
            async with self.database.write() as tx:
                return await leases.claim(tx, owner="w", lease=LEASE, now=self.now)

        held = self.run(work())
        if held is not None:
            assert held.fence > self.fences.get(held.job_id, 0)
            self.fences[held.job_id] = held.fence
            self.claims.append(held)

    def pick(self, number):
        return self.claims[number % len(self.claims)]

    def is_newest(self, held):
        return self.fences[held.job_id] == held.fence

    @precondition(lambda self: self.claims)
    @rule(number=picks)
    def beat(self, number):
        held = self.pick(number)

        async def work():
            async with self.database.write() as tx:
                return await leases.renew(tx, held, lease=LEASE, now=self.now)

        hold = self.run(work())
        assert hold is Hold.LOST or self.is_newest(held)

    @precondition(lambda self: self.claims)
    @rule(number=picks, verdict=st.sampled_from(Verdict))
    def finish(self, number, verdict):
        held = self.pick(number)

        async def work():
            async with self.database.write() as tx:
                result = make_result(verdict=verdict)
                await results.finish(tx, held, result, now=self.now, keep=1)

        try:
            self.run(work())
        except FencedJobError:
            return
        assert self.is_newest(held)
        self.covered |= set(held.trials)

    @precondition(lambda self: self.claims)
    @rule(number=picks)
    def fail(self, number):
        held = self.pick(number)

        async def work():
            async with self.database.write() as tx:
                return await leases.fail(tx, held, message="no", now=self.now)

        assert self.is_newest(held) or not self.run(work())

    @precondition(lambda self: self.claims)
    @rule(number=picks)
    def leave(self, number):
        held = self.pick(number)

        async def work():
            async with self.database.write() as tx:
                return await leases.give_back(tx, held, now=self.now)

        assert self.is_newest(held) or not self.run(work())

    @precondition(lambda self: self.recorded)
    @rule(number=picks)
    def cancel(self, number):
        every = sorted(self.recorded.values(), key=str)

        async def work():
            async with self.database.write() as tx:
                return await jobs.cancel(tx, every[number % len(every)], actor=None, now=self.now)

        job = self.run(work())
        assert job.cancelling or job.state.is_final

    async def _look(self):
        async with self.database.read() as tx:
            rows = list(await tx.scalars(select(JobRow)))
            stored = set(await tx.scalars(select(TrialRow.id)))
            made = list(await tx.scalars(select(VersionRow)))
        return rows, stored, made

    @invariant()
    def promises_hold(self):
        rows, stored, made = self.run(self._look())
        running = [row.user_uuid for row in rows if row.state == JobState.RUNNING]
        assert len(running) == len(set(running))
        waiting = [row.user_uuid for row in rows if row.state == JobState.QUEUED]
        assert len(waiting) == len(set(waiting))
        self._check_fences(rows)
        self._check_versions(rows, made)
        assert set(self.recorded) == stored
        ended = {row.id for row in rows if JobState(row.state).is_final}
        for trial, job in self.recorded.items():
            # a trial waits, is worked on, or was worked on, called off or given up with its job
            assert job in {row.id for row in rows}
            assert job not in ended or trial in self.covered or self._was_ended(rows, job)

    def _check_fences(self, rows):
        for row in rows:
            assert row.fence >= self.fences.get(row.id, 0)
            assert (row.lease_until is not None) == (row.state == JobState.RUNNING)
            assert (row.finished_at is not None) == JobState(row.state).is_final

    def _check_versions(self, rows, made):
        by_job = [version.job_id for version in made]
        assert len(by_job) == len(set(by_job)), "a job made two versions"
        finished = {row.id: row.version for row in rows if row.version is not None}
        assert {version.job_id: version.number for version in made} == finished
        active = [version.user_uuid for version in made if version.state == "active"]
        assert len(active) == len(set(active))

    def _was_ended(self, rows, job):
        reason = next(row.reason for row in rows if row.id == job)
        return reason in {JobReason.CANCELLED, JobReason.ERROR}


def test_promises_of_the_queue_hold_in_any_order(settings):
    with asyncio.Runner() as runner:
        database = Database.from_settings(settings)
        runner.run(upgrade(database))
        machine = type("Machine", (JobMachine,), {"runner": runner, "database": database})
        try:
            run_state_machine_as_test(
                machine,
                settings=limits(
                    max_examples=12,
                    stateful_step_count=20,
                    deadline=None,
                    suppress_health_check=list(HealthCheck),
                ),
            )
        finally:
            runner.run(database.close())
