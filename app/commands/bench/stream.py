"""`kinecast bench stream`: what one robot, or many, would feel on this machine."""

import asyncio
import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from app.commands.bench.generator import RATE_HZ, WARM_UP_S, Load, run_load
from app.commands.bench.probe import PAUSE_S, find_overlaps
from app.commands.bench.residents import find_settings, give_versions
from app.commands.client.errors import ApiError
from app.commands.client.messages import SUBPROTOCOLS
from app.commands.client.rest import Api
from app.commands.figures import summarize
from app.commands.own_server import run_own_server
from app.commands.target import Target

DEADLINE_MS = 33.0

Settle = Callable[[Sequence[str]], None]


@dataclass(frozen=True, slots=True)
class StreamPlan:
    """What to measure.

    Attributes:
        users: streams at the same time.
        seconds: of each run, after a warm-up.
        repeats: runs.
        form: `msgpack` or `json`.
    """

    users: int
    seconds: float
    repeats: int
    form: str


@contextmanager
def own_target(users: int) -> Iterator[tuple[Target, Settle]]:
    """Run a service of our own, with a database that is thrown away, and give people versions."""
    with tempfile.TemporaryDirectory(prefix="kinecast-bench-") as folder:
        room = max(64, users)
        with run_own_server(Path(folder), streams_per_key=room, log_level="warning") as server:
            yield (
                Target(server.url, server.key),
                partial(give_versions, find_settings(Path(folder))),
            )


def measure_stream(
    plan: StreamPlan, target: Target, *, settle: Settle | None = None
) -> dict[str, Any]:
    """Run the load several times and report every run and their medians.

    Args:
        plan: what to measure.
        target: which service.
        settle: gives the users versions of their own; None: the base answers.

    Raises:
        ClientError: the service cannot be reached, refuses, or ends a stream.
    """
    runs = asyncio.run(_run_all(plan, target, settle))
    within = [run["within_33_ms"] for run in runs]
    p50, p99 = ([run["latency_ms"][name] for run in runs] for name in ("p50", "p99"))
    return {
        "benchmark": "stream",
        "users": plan.users,
        "rate_hz": RATE_HZ,
        "seconds": plan.seconds,
        "warm_up_s": WARM_UP_S,
        "format": plan.form,
        "decoders": "base" if settle is None else "own",
        "cores": os.cpu_count(),
        "load_average": [round(load, 2) for load in os.getloadavg()],
        "median_of_runs": {
            "p50_ms": _median(p50),
            "p99_ms": _median(p99),
            "within_33_ms": _median(within),
        },
        "runs": runs,
    }


async def _run_all(plan: StreamPlan, target: Target, settle: Settle | None) -> list[dict[str, Any]]:
    users = [f"bench-{n}" for n in range(1, plan.users + 1)]
    runs = []
    async with Api(target.url, key=target.key) as api:
        made = [user for user in users if await api.add_user(user)]
        try:
            if settle is not None:
                await asyncio.to_thread(settle, users)
            for _ in range(plan.repeats):
                load = await run_load(
                    target.url,
                    users,
                    key=target.key,
                    subprotocol=SUBPROTOCOLS[plan.form],
                    seconds=plan.seconds,
                )
                runs.append(describe_load(load))
        finally:
            for user in made:
                with suppress(ApiError):
                    await api.delete_user(user)
    return runs


def describe_load(load: Load) -> dict[str, Any]:
    """Give the figures of one run, with the machine's own pauses and without them."""
    due, arrived, queue, compute = _gather(load)
    latency_ms = (arrived - due) * 1e3
    paused = find_overlaps(due, arrived, load.pauses)
    logs = load.streams
    refused: dict[str, int] = {}
    for log in logs:
        for code, count in log.refused.items():
            refused[code] = refused.get(code, 0) + count
    unanswered = sum(log.lost for log in logs)
    skipped = sum(log.skipped for log in logs)
    failed = skipped + sum(refused.values()) + unanswered
    late_ms = np.concatenate([np.array(log.late_s) for log in logs]) * 1e3
    pauses = [pause.seconds * 1e3 for pause in load.pauses]
    return {
        **_judge(latency_ms, failed),
        "frames": {
            "sent": sum(log.sent for log in logs),
            "answered": sum(len(log.answers) for log in logs),
            "measured": len(due),
            "waiting": sum(log.covered for log in logs),
            "skipped": skipped,
            "errors": refused,
            "unanswered": unanswered,
        },
        "server_ms": {
            "queue": summarize(queue).as_json(),
            "compute": summarize(compute).as_json(),
        },
        "host": {
            "pause_over_ms": PAUSE_S * 1e3,
            "pauses": len(pauses),
            "paused_ms": round(sum(pauses), 1),
            "longest_ms": round(max(pauses, default=0.0), 1),
            "sent_late_ms": summarize(late_ms).as_json(),
        },
        "without_pauses": {
            "excluded": int(paused.sum()),
            **_judge(latency_ms[~paused], failed),
        },
    }


def _gather(load: Load) -> Sequence[np.ndarray]:
    """Collect the answers to frames that were due after the warm-up."""
    answers = [answer for log in load.streams for answer in log.answers if answer[0] >= load.begin]
    return list(np.array(answers, dtype=np.float64).reshape(-1, 4).T)


def _judge(latency_ms: np.ndarray, failed: int) -> dict[str, Any]:
    """Judge latencies; frames that got no forecast count as missed."""
    in_time = int((latency_ms <= DEADLINE_MS).sum())
    due = len(latency_ms) + failed
    return {
        "latency_ms": summarize(latency_ms).as_json(),
        "within_33_ms": round(in_time / due, 5) if due else None,
        "misses": due - in_time,
    }


def _median(values: Sequence[float | None]) -> float | None:
    """Give the median of the runs that have a figure."""
    known = [value for value in values if value is not None]
    return median(known) if known else None
