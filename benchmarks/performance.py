"""Write the figures of docs/performance.md: run it with `make performance` on an idle machine.

It runs `kinecast bench` in processes of its own and prints the tables; `--json FILE` keeps every
run. About six minutes.
"""

import argparse
import json
import os
import platform
import subprocess
import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from statistics import median
from typing import Any

STREAMS = ((1, "msgpack"), (1, "json"), (8, "msgpack"), (32, "msgpack"), (64, "msgpack"))
PEOPLE = "1,8,32,128,512"
TIMEOUT_S = 600


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", default="20", help="of each run")
    parser.add_argument("--repeats", default="3", help="runs of each kind")
    parser.add_argument("--json", type=Path, help="write every run here")
    arguments = parser.parse_args()
    length = ["--seconds", arguments.seconds, "--repeats", arguments.repeats]
    streams = [
        _bench("stream", "--users", str(users), "--format", form, *length)
        for users, form in STREAMS
    ]
    forecast = _bench("forecast", "--users", PEOPLE)
    if arguments.json is not None:
        report = {"machine": _describe_machine(), "streams": streams, "forecast": forecast}
        arguments.json.write_text(json.dumps(report, indent=2) + "\n")
    print(
        f"{_describe_machine()}\n\n{_tabulate_streams(streams)}\n\n{_tabulate_forecast(forecast)}"
    )


def _bench(*arguments: str) -> dict[str, Any]:
    print("kinecast bench", *arguments, file=sys.stderr, flush=True)
    done = subprocess.run(
        [sys.executable, "-m", "app.cli", "bench", *arguments, "--json"],
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        check=False,
    )
    if done.returncode:
        sys.exit(done.stderr)
    report: dict[str, Any] = json.loads(done.stdout)
    return report


def _describe_machine() -> str:
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False
    ).stdout.strip()
    load = ", ".join(f"{value:.1f}" for value in os.getloadavg())
    model = _find_processor()
    today = datetime.now(UTC).date().isoformat()
    return f"{model}, {os.cpu_count()} cores, {today}, commit {commit}, load averages {load}"


def _find_processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def _tabulate_streams(reports: Sequence[dict[str, Any]]) -> str:
    rows = [
        "| streams at 30 Hz | format | p50 ms | p99 ms | within 33 ms | p99 ms without pauses "
        "| within 33 ms without pauses |",
        "|---|---|---|---|---|---|---|",
    ]
    for report in reports:
        told, runs = report["median_of_runs"], report["runs"]
        clean = [run["without_pauses"] for run in runs]
        clean_p99 = median(run["latency_ms"]["p99"] for run in clean)
        clean_share = median(run["within_33_ms"] for run in clean)
        rows.append(
            f"| {report['users']} | {report['format']} | {told['p50_ms']:.1f} "
            f"| {told['p99_ms']:.1f} | {told['within_33_ms']:.1%} "
            f"| {clean_p99:.1f} | {clean_share:.1%} |"
        )
    return "\n".join(rows)


def _tabulate_forecast(report: dict[str, Any]) -> str:
    rows = [
        "| people | way | forecasts per s | µs each, median | p99 | eager ÷ this | ÷ floor |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in report["rows"]:
        each = row["us_per_forecast"]
        rows.append(
            f"| {row['users']} | {row['way']} | {row['forecasts_per_s']} "
            f"| {each['median']:.0f} | {each['p99']:.0f} "
            f"| {row['times_eager']:.1f} | {row['times_floor'] or ''} |"
        )
    return "\n".join(rows)


if __name__ == "__main__":
    main()
