"""One fault after another, each at its own moment of a job."""

import asyncio
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from random import Random
from typing import Any

from app.commands.client.errors import ClientError
from app.commands.client.messages import Version
from app.commands.client.rest import Api
from app.storage.database import Database
from benchmarks.faults.audit import Findings, inspect
from benchmarks.faults.harm import Harm
from benchmarks.faults.people import Accepted, Upload, make_upload, send_until_accepted
from benchmarks.faults.rig import Rig
from benchmarks.faults.watch import ANSWER_S, Log, watch
from models.checkpoint import Checkpoint

TRIALS_PER_USER = 2
PATIENCE_S = 150.0
LOOK_S = 0.1
LONGEST_S = 12.0
"""Moments are drawn from no longer time than this, however slow the machine is."""
FINAL = frozenset({"succeeded", "rejected", "failed", "cancelled"})
LATE_STEP = 0.5
"""Every other fault waits for this share of the steps: storing is near."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of one repeat.

    Attributes:
        fault: which.
        hit: what the job did at that moment.
        job: how it ended.
        attempts: workers that had it.
        recovered_s: from the fault until the job had ended and forecasts were answered again.
        tries: how often the trial was sent.
        asked, streamed: forecasts that were answered.
        refused: requests that were told to come again.
        versions: weights that were seen to answer.
        closes: how streams ended.
        opened: streams that were opened.
        warned: what service and workers logged meanwhile, from warnings up.
        findings: what is wrong.
    """

    fault: str
    hit: str
    job: str
    attempts: int
    recovered_s: float
    tries: int
    asked: int
    streamed: int
    refused: int
    versions: list[str]
    closes: dict[str, int]
    opened: int
    warned: dict[str, int]
    findings: dict[str, list[str]]


class Campaign:
    """Repeats one fault.

    Args:
        rig: the service; it is started where it does not run.
        harm: the fault.
        base: the model that it serves.
        random: decides the moments.
    """

    def __init__(self, rig: Rig, harm: Harm, base: Checkpoint, random: Random) -> None:
        self._rig, self._harm, self._base, self._random = rig, harm, base, random
        self._typical_s = 4.0
        self._kept: dict[str, list[Accepted]] = {}

    async def run(self, repeats: int, tell: Callable[[Outcome], None]) -> list[Outcome]:
        """Break it again and again."""
        outcomes = []
        for number in range(repeats):
            await asyncio.to_thread(self._rig.freshen)
            outcome = await self._repeat(number)
            tell(outcome)
            outcomes.append(outcome)
        return outcomes

    async def _repeat(self, number: int) -> Outcome:
        person, take = divmod(number, TRIALS_PER_USER)
        user = f"person-{person}"
        upload = make_upload(user, seed=person, take=take)
        warned = self._rig.count_warnings()
        async with Api(self._rig.url, key=self._rig.key, wait_s=ANSWER_S) as api:
            await api.add_user(user)
            async with watch(self._rig, user, seed=person) as log:
                await until(lambda: log.answered_since(0.0) is not None)
                began = time.monotonic()
                accepted, hit, struck = await self._break(api, upload, log, late=number % 4 > 1)
                job = await wait_for_end(api, accepted.job)
                ended = time.monotonic()
                self._typical_s = (self._typical_s + min(ended - began, LONGEST_S)) / 2
                await until(lambda: log.answered_since(max(struck, ended)) is not None)
        kept = [*self._kept.get(user, []), accepted]
        self._kept[user] = kept
        findings = await self._inspect(user, kept, log, seed=person)
        if log.answered_since(max(struck, ended)) is None:
            findings.unanswered.append("no forecast after the fault")
        back = log.answered_since(struck) or time.monotonic()
        return Outcome(
            fault=self._harm.name,
            hit=hit,
            job=f"{job['state']}: {job['reason']}",
            attempts=int(job["attempt"]),
            recovered_s=round(max(ended, back) - struck, 2),
            tries=accepted.tries,
            asked=len(log.asked),
            streamed=len(log.streamed),
            refused=sum(log.refused.values()),
            versions=sorted({name_version(seen.version) for seen in (*log.asked, *log.streamed)}),
            closes=dict(log.closes),
            opened=log.opened,
            warned=dict(self._rig.count_warnings() - warned),
            findings=findings.as_json(),
        )

    async def _break(
        self, api: Api, upload: Upload, log: Log, *, late: bool
    ) -> tuple[Accepted, str, float]:
        """Send a trial, and break something between its first byte and the end of its job."""
        note = log.refused.update
        sending = asyncio.create_task(
            send_until_accepted(api, upload, patience_s=PATIENCE_S, note=lambda code: note([code]))
        )
        if late:
            await until(lambda: self._is_late(api, sending))
            await asyncio.sleep(self._random.uniform(0.0, 1.5))
        else:
            await asyncio.sleep(self._random.uniform(0.0, self._typical_s))
        hit = await self._look(api, sending)
        struck = time.monotonic()
        await asyncio.to_thread(self._harm.strike)
        await asyncio.sleep(self._random.uniform(*self._harm.hold_s))
        await asyncio.to_thread(self._harm.mend)
        return await sending, hit, struck

    async def _is_late(self, api: Api, sending: "asyncio.Task[Accepted]") -> bool:
        if not sending.done():
            return False
        job = await api.get_job(sending.result().job)
        progress = job["progress"] or {}
        step, steps = progress.get("step", 0), progress.get("steps", 1)
        return job["state"] in FINAL or step >= LATE_STEP * steps

    async def _look(self, api: Api, sending: "asyncio.Task[Accepted]") -> str:
        """Tell what the job is doing."""
        if not sending.done():
            return "uploading"
        job = await api.get_job(sending.result().job)
        if job["state"] != "running":
            return "waiting" if job["state"] == "queued" else "ended"
        return str((job["progress"] or {}).get("phase", "starting"))

    async def _inspect(
        self, user: str, accepted: list[Accepted], log: Log, *, seed: int
    ) -> Findings:
        database = Database.from_settings(self._rig.settings)
        try:
            return await inspect(database, user, accepted, log, self._base, seed=seed)
        finally:
            await database.close()


async def wait_for_end(api: Api, job: str) -> dict[str, Any]:
    """Wait until a job has ended, but not for ever; gives how it stands then."""
    deadline = time.monotonic() + PATIENCE_S
    while True:
        try:
            found = await api.get_job(job)
        except ClientError:
            if time.monotonic() > deadline:
                raise
        else:
            if found["state"] in FINAL or time.monotonic() > deadline:
                return found
        await asyncio.sleep(LOOK_S)


async def until(holds: Callable[[], Any]) -> None:
    """Wait until something holds, but not for ever; the audit finds what does not."""
    deadline = time.monotonic() + PATIENCE_S / 3
    while True:
        found = holds()
        if (await found if asyncio.iscoroutine(found) else found) or time.monotonic() > deadline:
            return
        await asyncio.sleep(LOOK_S)


def name_version(version: Version) -> str:
    """Say in a word which weights answered, and why it was not others."""
    mark = "" if version.fallback is None else f" ({version.fallback})"
    return f"{version.number}{mark}"


def as_json(outcome: Outcome) -> dict[str, Any]:
    """Give an outcome for a report."""
    return asdict(outcome)
