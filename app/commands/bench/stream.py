"""`kinecast bench stream`: what one robot, or many, would feel on this machine."""

import asyncio
import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from app.commands.bench.clockwork import run_precisely
from app.commands.bench.disturbance import disturbing
from app.commands.bench.generator import RATE_HZ, WARM_UP_S, run_load
from app.commands.bench.report import describe_load
from app.commands.bench.residents import find_settings, give_versions
from app.commands.bench.scenarios import Scenario
from app.commands.client.errors import ApiError
from app.commands.client.messages import SUBPROTOCOLS
from app.commands.client.rest import Api
from app.commands.figures import take_median
from app.commands.own_server import run_own_server
from app.commands.target import Target

LATE_SHARE = 0.001
"""A machine carries as many people as have at most this share of their frames missed."""

Settle = Callable[[Sequence[str]], None]
Progress = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class StreamPlan:
    """What to measure.

    Attributes:
        users: numbers of streams at the same time, one after the other.
        seconds: of each run, after a warm-up.
        repeats: runs of each number.
        form: `msgpack` or `json`.
        scenarios: what happens besides.
    """

    users: Sequence[int]
    seconds: float
    repeats: int
    form: str
    scenarios: frozenset[Scenario] = frozenset()


@dataclass(frozen=True, slots=True)
class Subject:
    """The service to measure.

    Attributes:
        target: where it is, and the key.
        settle: gives users two versions of their own; None: the base answers.
        process: the service itself, where it is ours.
    """

    target: Target
    settle: Settle | None = None
    process: int | None = None


@contextmanager
def own_subject(users: int, *, base: bool = False) -> Iterator[Subject]:
    """Run a service of our own, with a database that is thrown away, and give people versions.

    Args:
        users: most streams at the same time.
        base: give nobody a version.
    """
    with tempfile.TemporaryDirectory(prefix="kinecast-bench-") as folder:
        room = max(64, 2 * users)  # a stream that is left may not be gone when it comes back
        with run_own_server(Path(folder), streams_per_key=room, log_level="warning") as server:
            settle = None if base else partial(give_versions, find_settings(Path(folder)), each=2)
            yield Subject(Target(server.url, server.key), settle, server.process.pid)


def measure_stream(
    plan: StreamPlan, subject: Subject, *, progress: Progress = lambda _: None
) -> dict[str, Any]:
    """Run the load several times with each number of streams.

    Args:
        plan: what to measure.
        subject: which service.
        progress: told what is measured.

    Returns:
        Of one number of streams every run and their medians; of several the curve, and that of
        each.

    Raises:
        ClientError: the service cannot be reached, refuses, or ends a stream.
    """
    runs = run_precisely(_run_all(plan, subject, progress))
    common = {
        "benchmark": "stream",
        "rate_hz": RATE_HZ,
        "seconds": plan.seconds,
        "warm_up_s": WARM_UP_S,
        "format": plan.form,
        "with": sorted(plan.scenarios),
        "decoders": "base" if subject.settle is None else "own",
        "cores": os.cpu_count(),
        "load_average": [round(load, 2) for load in os.getloadavg()],
    }
    loads = [describe_runs(users, runs[users]) for users in plan.users]
    if len(loads) == 1:
        return {**common, **loads[0]}
    return {**common, **describe_curve(loads), "loads": loads}


async def _run_all(
    plan: StreamPlan, subject: Subject, progress: Progress
) -> dict[int, list[dict[str, Any]]]:
    """Run every load; gives the figures of the runs of each number of streams."""
    target, users = subject.target, [f"bench-{n}" for n in range(1, max(plan.users) + 1)]
    runs: dict[int, list[dict[str, Any]]] = {count: [] for count in plan.users}
    async with Api(target.url, key=target.key) as api:
        progress(f"making {len(users)} users")
        made = [user for user in users if await api.add_user(user)]
        try:
            if subject.settle is not None:
                await asyncio.to_thread(subject.settle, users)
            for count in plan.users:
                for number in range(1, plan.repeats + 1):
                    progress(f"{count} streams, run {number} of {plan.repeats}")
                    runs[count].append(await _run_once(plan, subject, users[:count]))
        finally:
            for user in made:
                with suppress(ApiError):
                    await api.delete_user(user)
    return runs


async def _run_once(plan: StreamPlan, subject: Subject, users: Sequence[str]) -> dict[str, Any]:
    async with disturbing(subject.target, users, plan.scenarios) as done:
        load = await run_load(
            subject.target.url,
            users,
            key=subject.target.key,
            subprotocol=SUBPROTOCOLS[plan.form],
            seconds=plan.seconds,
            server=subject.process,
            scenarios=plan.scenarios,
        )
    return {**describe_load(load), "disturbances": done}


def describe_runs(users: int, runs: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Give the runs of one number of streams, and their medians."""

    def middle(*names: str) -> float | None:
        return take_median([_pick(run, names) for run in runs])

    return {
        "users": users,
        "median_of_runs": {
            "p50_ms": middle("latency_ms", "p50"),
            "p99_ms": middle("latency_ms", "p99"),
            "p99_9_ms": middle("latency_ms", "p99_9"),
            "within_33_ms": middle("within_33_ms"),
            "p99_ms_without_pauses": middle("without_pauses", "latency_ms", "p99"),
            "within_33_ms_without_pauses": middle("without_pauses", "within_33_ms"),
            "worst_user_answered": middle("fairness", "worst_user_answered"),
            "server_us_per_forecast": middle("usage", "server", "us_per_forecast"),
            "generator_us_per_forecast": middle("usage", "generator", "us_per_forecast"),
        },
        "runs": list(runs),
    }


def describe_curve(loads: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Give one row for each number of streams, and the largest that this machine carries."""
    rows = [_describe_row(load) for load in loads]

    def find_largest(name: str) -> int | None:
        fit = [row["users"] for row in rows if row[name] is not None and row[name] <= LATE_SHARE]
        return max(fit, default=None)

    return {
        "curve": rows,
        "largest": {
            "missed_share_at_most": LATE_SHARE,
            "users": find_largest("missed_share"),
            "users_without_pauses": find_largest("missed_share_without_pauses"),
        },
    }


def _describe_row(load: dict[str, Any]) -> dict[str, Any]:
    runs = load["runs"]
    clean = [run["without_pauses"] for run in runs]
    return {
        "users": load["users"],
        **load["median_of_runs"],
        "due": sum(run["due"] for run in runs),
        "misses": sum(run["misses"] for run in runs),
        "skipped": sum(run["frames"]["skipped"] for run in runs),
        "missed_share": _find_share(runs),
        "missed_share_without_pauses": _find_share(clean),
        "server_memory_mib": _pick(runs[-1], ("usage", "server_memory_mib", "end")),
    }


def _find_share(runs: Sequence[dict[str, Any]]) -> float | None:
    """Give the share of missed frames over all runs."""
    due = sum(run["due"] for run in runs)
    return round(sum(run["misses"] for run in runs) / due, 6) if due else None


def _pick(run: Any, names: Sequence[str]) -> Any:  # noqa: ANN401 - a figure out of JSON
    """Give a figure that lies some levels deep, None where one of them is not there."""
    for name in names:
        if run is None:
            return None
        run = run[name]
    return run
