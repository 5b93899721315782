"""Write the figures of docs/performance.md: run it with `make performance` on an idle machine.

It runs `kinecast bench` in processes of its own and prints the tables; `--json FILE` keeps every
run. About a quarter of an hour.
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
from typing import Any

STREAMS = (("1,8,32,64,96,128,160,200", "msgpack"), ("1,32", "json"))
PEOPLE = "1,8,32,128,512"
TIMEOUT_S = 3600


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", default="20", help="of each run")
    parser.add_argument("--repeats", default="3", help="runs of each kind")
    parser.add_argument("--json", type=Path, help="write every run here")
    arguments = parser.parse_args()
    length = ["--seconds", arguments.seconds, "--repeats", arguments.repeats]
    streams = [
        _bench("stream", "--users", users, "--format", form, *length) for users, form in STREAMS
    ]
    forecast = _bench("forecast", "--users", PEOPLE)
    if arguments.json is not None:
        report = {"machine": describe_machine(), "streams": streams, "forecast": forecast}
        arguments.json.write_text(json.dumps(report, indent=2) + "\n")
    print(f"{describe_machine()}\n\n{_tabulate_streams(streams)}\n\n{_tabulate_forecast(forecast)}")


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


def describe_machine() -> str:
    """Name the processor, the commit and how busy the machine is."""
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
        "| streams at 30 Hz | format | p50 ms | p99 ms | p99.9 ms | within 33 ms | missed "
        "| skipped | p99 ms without pauses | within 33 ms without pauses | worst user answered "
        "| service µs per forecast | client µs | service MiB |",
        "|---" * 14 + "|",
    ]
    for report in reports:
        rows += [_write_row(report["format"], row) for row in report["curve"]]
    limits = (
        f"{report['format']}: at most {report['largest']['missed_share_at_most']:.1%} missed up to "
        f"{report['largest']['users']} of these, without pauses "
        f"{report['largest']['users_without_pauses']}"
        for report in reports
    )
    return "\n".join([*rows, "", *limits])


def _write_row(form: str, row: dict[str, Any]) -> str:
    cells = (
        row["users"],
        form,
        *(_show(row[name]) for name in ("p50_ms", "p99_ms", "p99_9_ms")),
        f"{row['within_33_ms']:.2%}",
        row["misses"],
        row["skipped"],
        _show(row["p99_ms_without_pauses"]),
        f"{row['within_33_ms_without_pauses']:.2%}",
        f"{row['worst_user_answered']:.1%}",
        _show(row["server_us_per_forecast"], 0),
        _show(row["generator_us_per_forecast"], 0),
        _show(row["server_memory_mib"], 0),
    )
    return f"| {' | '.join(map(str, cells))} |"


def _show(value: float | None, digits: int = 1) -> str:
    return "" if value is None else f"{value:.{digits}f}"


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
