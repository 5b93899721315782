"""Kinecast beside LitServe, Ray Serve and PyTorch alone: run it with `make peers` (about 9 min).

Everybody serves the same weights, a decoder for each person behind the shipped base, on this
machine, to the same number of clients in a closed loop: each asks again as soon as it has its
answer. Answers are checked against PyTorch's. The table has the median of several repetitions after
a warm-up, and the lowest and the highest in brackets; `processor ms` is what the server's processes
worked on a forecast. Rows whose package is not installed are left out.
"""

import argparse
import asyncio
import json
import os
import sys
import tempfile
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from app.commands.client.errors import ClientError
from app.commands.own_server import OwnServerError
from benchmarks.peers.clients import PeerError
from benchmarks.peers.effort import measure_effort
from benchmarks.peers.load import run_closed
from benchmarks.peers.people import invent_people
from benchmarks.peers.report import explain_missing, list_versions, summarise_runs, tabulate
from benchmarks.peers.rows import Crowd, Row, Served, list_rows
from benchmarks.performance import describe_machine
from models.arithmetic import arithmetic

FAILURES = (PeerError, OwnServerError, ClientError, OSError, EOFError)
"""What a server can do wrong; its row is left out, and the others are measured."""


async def measure_row(
    row: Row, crowd: Crowd, *, seconds: float, warm_up_s: float, repeats: int
) -> dict[str, Any]:
    """Serve people in one way and load it several times.

    Raises:
        PeerError: it does not serve what it should; others of `FAILURES` alike.
    """
    async with row.open(crowd) as served:
        await run_closed(served.clients, warm_up_s)
        runs = [await _measure_once(served, seconds) for _ in range(repeats)]
    told = {"way": row.name, "people": len(crowd.people), "clients": len(served.clients)}
    return {**told, **summarise_runs(runs), "runs": runs}


async def _measure_once(served: Served, seconds: float) -> dict[str, Any]:
    """Load a server once, and see what that cost its processes."""
    before = measure_effort(served.process)
    run = await run_closed(served.clients, seconds)
    after = measure_effort(served.process)
    told = run.as_json()
    worked = None if before is None or after is None or not run.asked else after - before
    return {**told, "processor_ms": None if worked is None else round(worked / run.asked * 1e3, 3)}


def measure(given: argparse.Namespace) -> dict[str, Any]:
    """Measure every row for every number of people."""
    rows: list[dict[str, Any]] = []
    left_out: list[str] = []
    for count in given.people:
        for row in list_rows(given.workers):
            missing = explain_missing(row.package)
            if missing is not None:
                left_out.append(f"{row.name}: {missing}")
                continue
            print(f"{count} people: {row.name}", file=sys.stderr, flush=True)
            try:
                rows.append(_measure_alone(row, count, given))
            except FAILURES as error:
                left_out.append(f"{row.name}, {count} people: {error or type(error).__name__}")
    return {
        "benchmark": "peers",
        "seconds": given.seconds,
        "warm_up_s": given.warm_up,
        "repeats": given.repeats,
        "workers": given.workers,
        "rows": rows,
        "left_out": list(dict.fromkeys(left_out)),
    }


def _measure_alone(row: Row, count: int, given: argparse.Namespace) -> dict[str, Any]:
    """Measure one row with people and a loop of its own."""
    with tempfile.TemporaryDirectory(prefix="kinecast-peers-") as folder, arithmetic(1):
        crowd = Crowd(invent_people(count, Path(folder)), Path(folder))
        lengths = {"seconds": given.seconds, "warm_up_s": given.warm_up}
        told = asyncio.run(measure_row(row, crowd, repeats=given.repeats, **lengths))
    return {**told, "load_average": [round(load, 1) for load in os.getloadavg()]}


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--people", type=_read_counts, default=[8, 32], help="such as 8,32")
    parser.add_argument("--seconds", type=float, default=4.0, help="of each repetition")
    parser.add_argument("--warm-up", type=float, default=2.0, help="seconds before the first")
    parser.add_argument("--repeats", type=int, default=5, help="of each row")
    parser.add_argument(
        "--workers", type=int, default=os.cpu_count(), help="of each peer with own decoders"
    )
    parser.add_argument("--json", type=Path, help="write every run here")
    given = parser.parse_args(arguments)
    begun = datetime.now(UTC).isoformat(timespec="minutes")
    machine, versions = describe_machine(), list_versions()
    head = {"machine": machine, "begun": begun, "versions": versions}
    report = {**head, **measure(given)}
    if given.json is not None:
        given.json.write_text(json.dumps(report, indent=2) + "\n")
    installed = (f"{name} {version}" for name, version in versions.items() if version)
    print(f"{machine}, begun {begun}\n{', '.join(installed)}\n\n{tabulate(report['rows'])}")
    for reason in report["left_out"]:
        print(f"\nLeft out: {reason}")
    return 0 if report["rows"] else 1


def _read_counts(told: str) -> list[int]:
    return [int(count) for count in told.split(",")]


if __name__ == "__main__":
    raise SystemExit(main())
