"""The worker: claims a job, keeps it alive while a child trains, and ends it. No rule of its own.

The heartbeat is here and the training is in another process, so that however busy that is, the
lease is renewed; and whatever becomes of that process, the job goes on from here.
"""

import asyncio
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import dataclass
from datetime import timedelta
from time import monotonic
from typing import Any, TypeVar

import structlog

from app.domain.errors import InternalError, NotReadyError, UnknownUserError
from app.domain.jobs import Claim, JobReason
from app.personalize.promote import prepare_task, store_outcome
from app.personalize.run import Outcome, Task
from app.storage import leases
from app.storage.announcements import Topic
from app.storage.clock import read_clock
from app.storage.database import Database
from app.storage.leases import Hold
from app.storage.results import FencedJobError
from app.worker.messages import Done, Failed, Progress
from app.worker.trainee import Trainee

LOOK_EVERY_S = 0.4
"""How often a worker looks whether its job is still wanted: cancelling takes less than a second."""
TRAINER = "app.personalize.trainer:train"

Value = TypeVar("Value")
log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class WorkerRules:
    """How a worker works; see the settings of the same names.

    Attributes:
        owner: who this worker is, for people.
        base: the base model, as its file.
        base_sha256: its digest.
        trainer: `module:function` of what fits and judges.
    """

    owner: str
    base: bytes
    base_sha256: str
    trainer: str = TRAINER
    poll_s: float = 1.0
    lease_s: float = 30.0
    heartbeat_s: float = 5.0
    timeout_s: float = 900.0
    threads: int = 1
    steps: int | None = None
    nice: int = 0
    versions_kept: int = 10


class Worker:
    """Works on one job after the other until told to stop.

    Args:
        database: where the jobs are.
        rules: how to work.
        stop: set to leave; a job that is being worked on is given back.
    """

    def __init__(self, database: Database, rules: WorkerRules, stop: asyncio.Event) -> None:
        self._database, self._rules, self._stop = database, rules, stop
        self._lease = timedelta(seconds=rules.lease_s)
        self._ear = database.announcements.listen(Topic.JOBS)

    async def run(self) -> None:
        """Work until stopped."""
        log.info("worker started", owner=self._rules.owner)
        while not self._stop.is_set():
            held = await self._claim()
            if held is None:
                await self._wait_for_jobs()
                continue
            await self._work(held)
        log.info("worker stopped", owner=self._rules.owner)

    async def run_pending(self) -> int:
        """Work until nothing is to be done now; gives how many jobs there were."""
        count = 0
        while not self._stop.is_set() and (held := await self._claim()) is not None:
            await self._work(held)
            count += 1
        return count

    async def _claim(self) -> Claim | None:
        try:
            async with self._database.write() as tx:
                now = await read_clock(tx)
                return await leases.claim(
                    tx,
                    owner=self._rules.owner,
                    lease=self._lease,
                    now=now,
                    base_sha256=self._rules.base_sha256,
                )
        except (NotReadyError, InternalError) as error:
            log.warning("no job can be claimed", why=error.message)
            return None

    async def _work(self, held: Claim) -> None:
        log.info("job started", job=str(held.job_id), attempt=held.attempt)
        try:
            await self._carry_out(held)
        except InternalError as error:  # the next attempt may come to something else
            log.warning("attempt failed", job=str(held.job_id), why=error.message)
            with suppress(InternalError):  # then the lease runs out
                await self._until_ready(lambda: self._fail(held, error.message))

    async def _carry_out(self, held: Claim) -> None:
        if held.cancelled:
            await self._close_cancelled(held)
            return
        try:
            task = await self._until_ready(lambda: self._prepare(held))
        except UnknownUserError:
            return
        if task is None:
            return
        async with Trainee.start(task, self._rules.trainer, nice=self._rules.nice) as trainee:
            end = await self._attend(held, trainee)
        await self._end(held, task, end)

    async def _prepare(self, held: Claim) -> Task:
        async with self._database.read() as tx:
            return await prepare_task(
                tx,
                held,
                base=self._rules.base,
                base_sha256=self._rules.base_sha256,
                threads=self._rules.threads,
                steps=self._rules.steps,
            )

    async def _attend(self, held: Claim, trainee: Trainee) -> "Outcome | Hold | str | None":
        """Wait for the end of the training, and keep the lease meanwhile.

        Returns:
            The outcome; or why there is none: `CANCELLED` or `LOST`, an error for people, or None
            where this worker has to leave.
        """
        began = beaten = monotonic()
        progress: dict[str, Any] | None = None
        while not self._stop.is_set():
            reply = await trainee.wait(LOOK_EVERY_S)
            if isinstance(reply, Done):
                return reply.outcome
            if isinstance(reply, Failed):
                return reply.message
            if isinstance(reply, str):
                return reply
            if isinstance(reply, Progress):
                progress = reply.values
            if monotonic() - began > self._rules.timeout_s:
                return f"Training took longer than {self._rules.timeout_s:g} s."
            is_due = monotonic() - beaten >= self._rules.heartbeat_s
            hold = await self._show_life(held, progress, is_due=is_due)
            if hold in {Hold.CANCELLED, Hold.LOST}:
                return hold
            if hold is not None and (is_due or progress is not None):
                beaten, progress = monotonic(), None
        return None

    async def _show_life(
        self, held: Claim, progress: dict[str, Any] | None, *, is_due: bool
    ) -> Hold | None:
        """Renew the lease where it is time or there is news, else look; None if nobody answers.

        Without a database the training goes on: at the end the fence decides.
        """
        try:
            if not is_due and progress is None:
                async with self._database.read() as tx:
                    return await leases.look(tx, held)
            async with self._database.write() as tx:
                now = await read_clock(tx)
                return await leases.renew(tx, held, lease=self._lease, now=now, progress=progress)
        except NotReadyError as error:
            log.warning("no sign of life", job=str(held.job_id), why=error.message)
            return None

    async def _end(self, held: Claim, task: Task, end: "Outcome | Hold | str | None") -> None:
        """Write down how it ended."""
        if end is Hold.LOST:
            why = "another worker took it over, or its user was erased"
            log.warning("job no longer ours", job=str(held.job_id), why=why)
        elif end is Hold.CANCELLED:
            await self._close_cancelled(held)
        elif isinstance(end, str):
            log.warning("attempt failed", job=str(held.job_id), why=end)
            await self._until_ready(lambda: self._fail(held, end))
        elif end is None:
            await self._give_back(held)
        else:
            await self._store(held, end, parent=task.parent)

    async def _store(self, held: Claim, outcome: Outcome, *, parent: int) -> None:
        try:
            reason = await self._until_ready(lambda: self._store_once(held, outcome, parent))
        except (FencedJobError, UnknownUserError) as error:
            log.warning("result discarded", job=str(held.job_id), why=str(error))
            return
        log.info("job ended", job=str(held.job_id), reason=reason)

    async def _store_once(self, held: Claim, outcome: Outcome, parent: int) -> JobReason:
        async with self._database.write() as tx:
            now = await read_clock(tx)
            return await store_outcome(
                tx,
                held,
                outcome,
                parent=parent,
                base_sha256=self._rules.base_sha256,
                now=now,
                keep=self._rules.versions_kept,
            )

    async def _fail(self, held: Claim, message: str) -> bool:
        async with self._database.write() as tx:
            now = await read_clock(tx)
            return await leases.fail(tx, held, message=message, now=now)

    async def _close_cancelled(self, held: Claim) -> None:
        async def close() -> bool:
            async with self._database.write() as tx:
                return await leases.close_cancelled(tx, held, now=await read_clock(tx))

        await self._until_ready(close)
        log.info("job cancelled", job=str(held.job_id))

    async def _give_back(self, held: Claim) -> None:
        """Let another worker go on at once; if the database does not answer, the lease runs out."""
        with suppress(NotReadyError):
            async with self._database.write() as tx:
                await leases.give_back(tx, held, now=await read_clock(tx))
        log.info("job given back", job=str(held.job_id))

    async def _until_ready(self, step: Callable[[], Awaitable[Value]]) -> Value | None:
        """Repeat a step until the database answers; None where this worker has to leave first.

        Raises:
            InternalError: the database does answer, and refuses.
        """
        while True:
            try:
                return await step()
            except NotReadyError as error:
                log.warning("the database does not answer", why=error.message)
                if self._stop.is_set():
                    return None
                await self._pause(self._rules.poll_s)

    async def _wait_for_jobs(self) -> None:
        """Wait until it is time to look, a hint says that there may be a job, or it is over."""
        hint = asyncio.create_task(self._ear.wait(self._rules.poll_s))
        over = asyncio.create_task(self._stop.wait())
        await asyncio.wait({hint, over}, return_when=asyncio.FIRST_COMPLETED)
        for task in (hint, over):
            task.cancel()
            with suppress(asyncio.CancelledError):
                await task

    async def _pause(self, seconds: float) -> None:
        with suppress(TimeoutError):
            await asyncio.wait_for(self._stop.wait(), seconds)
