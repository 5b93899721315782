"""Many people record at once: do all get their job, in fair order, and what does it cost?

Run it with `make crowd` (about 20 min on two cores). A service with its own worker; everybody
uploads one trial of three clips of a synthetic person, a few record again as soon as they were
served, and some come late, while the queue is half empty. One stream runs at 30 Hz beside it. Fits
have few steps: what is measured is the queue, not the learning.
"""

import argparse
import asyncio
import json
import os
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any
from uuid import UUID

import httpx

from app.commands.client.rest import Api
from app.commands.figures import summarize
from app.commands.import_ import FINAL, make_body
from app.commands.own_server import OwnServer, run_own_server
from app.domain.jobs import fair_order
from app.settings import make_environment
from benchmarks.crowd_memory import MemoryLog
from models.data.clips import Clip
from models.data.synthetic import SyntheticPerson

ACTIONS = ("walk", "wave", "squat")
CLIP_S = 5.2
"""Two blocks each, so that there is enough to judge by."""
POLL_S = 2.0
STREAM_S = 30
RESTLESS, LATE = 3, 10
PEOPLE = 20
"""Different synthetic people; the others show the same motion as one of them."""
UPLOADS = 4
SLACK_S = 0.5
"""A job that was stored so shortly before another one started may have come too late for it."""


@dataclass(frozen=True)
class Job:
    """A finished job."""

    user: str
    id: UUID
    state: str
    reason: str
    attempt: int
    created: datetime
    started: datetime
    finished: datetime

    @classmethod
    def read(cls, job: dict[str, Any]) -> "Job":
        """Read what the service tells of it."""
        return cls(
            user=job["user"],
            id=UUID(job["id"]),
            state=job["state"],
            reason=job["reason"],
            attempt=job["attempt"],
            created=datetime.fromisoformat(job["created_at"]),
            started=datetime.fromisoformat(job["started_at"]),
            finished=datetime.fromisoformat(job["finished_at"]),
        )


class Crowd:
    """The people, and what they do.

    Args:
        api: of the service.
        http: the same, for what `Api` does not have.
        users: how many.
    """

    def __init__(self, api: Api, http: httpx.AsyncClient, users: int) -> None:
        self._api, self._http = api, http
        self._late = [f"late-{n}" for n in range(min(LATE, users // 4))]
        self._restless = [f"restless-{n}" for n in range(min(RESTLESS, users // 4))]
        self._patient = [
            f"patient-{n}" for n in range(users - len(self._late) - len(self._restless))
        ]
        self._bodies = [_perform(seed) for seed in range(min(PEOPLE, users))]
        self._last: dict[str, str] = {}
        self._jobs: dict[str, int] = {}

    async def queue(self) -> float:
        """Let all but the late ones record; gives how long that took, in seconds."""
        began = time.monotonic()
        gate = asyncio.Semaphore(UPLOADS)
        await asyncio.gather(*(self._record(u, gate) for u in (*self._restless, *self._patient)))
        return time.monotonic() - began

    async def watch(self) -> list[Job]:
        """Let the others come, and wait for the end of everything."""
        gate, came = asyncio.Semaphore(UPLOADS), False
        while True:
            jobs = await self._list_jobs()
            ended = sum(job["state"] in FINAL for job in jobs)
            served = {job["user"] for job in jobs if job["state"] in FINAL}
            if not came and len(served) * 2 >= len(self._patient):
                await asyncio.gather(*(self._record(user, gate) for user in self._late))
                came = True
            elif not served.issuperset((*self._patient, *self._late)):
                await self._record_again(jobs, gate)
            elif ended == len(jobs):
                return [Job.read(job) for job in jobs]
            print(f"{ended} of {len(jobs)} jobs ended", flush=True)
            await asyncio.sleep(POLL_S)

    async def _record_again(self, jobs: Sequence[dict[str, Any]], gate: asyncio.Semaphore) -> None:
        """Let those who never have enough record another trial as soon as they were served."""
        states = {job["id"]: job["state"] for job in jobs}
        for user in self._restless:
            if states.get(self._last[user]) in FINAL:
                await self._record(user, gate)

    async def _record(self, user: str, gate: asyncio.Semaphore) -> None:
        async with gate:
            await self._api.add_user(user)
            number = self._jobs[user] = self._jobs.get(user, 0) + 1
            body = self._bodies[sum(user.encode()) % len(self._bodies)]
            answer = await self._api.add_trial(
                user, body, media_type="application/msgpack", token=f"{user}-{number}"
            )
        self._last[user] = answer["job"]["id"]

    async def _list_jobs(self) -> list[dict[str, Any]]:
        jobs: list[dict[str, Any]] = []
        query: dict[str, Any] = {"limit": 100}
        while True:
            answer = await self._http.get("/v1/admin/jobs", params=query)
            answer.raise_for_status()
            page = answer.json()
            jobs += page["items"]
            if page["next_cursor"] is None:
                return jobs
            query["cursor"] = page["next_cursor"]


def _perform(seed: int) -> bytes:
    person = SyntheticPerson(seed)
    clips = [
        Clip(person.record(action, CLIP_S, noise=True), str(seed), action, "1", "synthetic")
        for action in ACTIONS
    ]
    return make_body("crowd", clips, finetune=True).content


def count_out_of_turn(jobs: Sequence[Job]) -> int:
    """Count the jobs that were started although another one's turn it was."""
    served: dict[str, datetime] = {}
    wrong = 0
    waiting = sorted(jobs, key=lambda job: job.started)
    while waiting:
        job = waiting.pop(0)
        there = [one for one in waiting if (job.started - one.created).total_seconds() > SLACK_S]
        wrong += any(_turn(one, served) < _turn(job, served) for one in there)
        served[job.user] = job.started
    return wrong


def _turn(job: Job, served: dict[str, datetime]) -> Any:  # noqa: ANN401 - only compared
    return fair_order(served_at=served.get(job.user), created_at=job.created, job_id=job.id)


def summarise(jobs: Sequence[Job]) -> dict[str, Any]:
    """Give the figures of the queue, of seconds all."""
    first: dict[str, Job] = {}
    for job in sorted(jobs, key=lambda job: job.created):
        first.setdefault(job.user, job)
    begin, end = min(job.created for job in jobs), max(job.finished for job in jobs)
    seconds = [(job.finished - job.started).total_seconds() for job in jobs]
    waits = [(job.started - job.created).total_seconds() for job in first.values()]
    late = [
        (job.started - job.created).total_seconds()
        for user, job in first.items()
        if user.startswith("late")
    ]
    reasons: dict[str, int] = {}
    for job in jobs:
        reasons[f"{job.state}: {job.reason}"] = reasons.get(f"{job.state}: {job.reason}", 0) + 1
    return {
        "users": len(first),
        "jobs": len(jobs),
        "ended": reasons,
        "attempts_over_1": sum(job.attempt > 1 for job in jobs),
        "out_of_turn": count_out_of_turn(jobs),
        "jobs_per_minute": round(60 * len(jobs) / (end - begin).total_seconds(), 2),
        "wait_of_the_last_s": round(max(waits), 1),
        "wait_of_late_comers_s": summarize(late).as_json(),
        "job_s": summarize(seconds).as_json(),
    }


async def stream_for_ever(server: OwnServer, rows: list[dict[str, Any]]) -> None:
    """Measure one stream at 30 Hz, half a minute at a time, from a process of its own."""
    command = ["bench", "stream", "--users", "1", "--repeats", "1", "--json", "--seconds"]
    environment = make_environment() | {"KINECAST_KEY": server.key}
    while True:
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "app.cli", *command, str(STREAM_S), "--url", server.url),
            stdout=asyncio.subprocess.PIPE,
            env=environment,
        )
        try:
            content, _ = await process.communicate()
        except asyncio.CancelledError:
            process.terminate()
            await process.wait()
            raise
        rows.append(json.loads(content)["runs"][0])


async def measure(server: OwnServer, users: int) -> dict[str, Any]:
    """Run the crowd beside a stream."""
    runs: list[dict[str, Any]] = []
    memory = MemoryLog(server.process.pid)
    headers = {"Authorization": f"Bearer {server.key}"}
    async with (
        Api(server.url, key=server.key, wait_s=60.0) as api,
        httpx.AsyncClient(base_url=server.url, headers=headers, timeout=60.0) as http,
    ):
        tasks = [
            asyncio.create_task(stream_for_ever(server, runs)),
            asyncio.create_task(memory.sample_for_ever()),
        ]
        try:
            crowd = Crowd(api, http, users)
            queued_s = await crowd.queue()
            jobs = await crowd.watch()
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
    latency = [run["latency_ms"] for run in runs]
    return {
        **summarise(jobs),
        "queued_within_s": round(queued_s, 1),
        "stream": {
            "runs": len(runs),
            "p50_ms": summarize([run["p50"] for run in latency]).as_json(),
            "p99_ms": summarize([run["p99"] for run in latency]).as_json(),
        },
        "memory_mib": memory.summarise(),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--users", type=int, default=200)
    parser.add_argument("--steps", type=int, default=4, help="of one fit")
    parser.add_argument("--json", type=Path, help="write the figures here")
    arguments = parser.parse_args()
    with (
        tempfile.TemporaryDirectory(prefix="kinecast-crowd-") as folder,
        run_own_server(Path(folder), finetune_steps=arguments.steps, log_level="warning") as server,
    ):
        report = asyncio.run(measure(server, arguments.users))
    load = [round(part, 1) for part in os.getloadavg()]
    report = {"steps": arguments.steps, "cores": os.cpu_count(), "load_average": load, **report}
    print(json.dumps(report, indent=2))
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(report, indent=2) + "\n")
    failed = [name for name in report["ended"] if name.startswith(("failed", "cancelled"))]
    return 1 if failed or report["out_of_turn"] else 0


if __name__ == "__main__":
    raise SystemExit(main())
