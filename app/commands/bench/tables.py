"""The reports of `kinecast bench` as tables."""

from collections.abc import Sequence
from typing import Any

from rich.table import Table

_CAPTION = (
    "ms; in time: within 33 ms · worst user: the least share of anybody's frames that was answered"
    " · after the first bar: without the machine's own pauses · after the second: processor time"
    " of a forecast, memory of the service"
)


def tabulate_stream(report: dict[str, Any]) -> Table:
    """Show the runs of one number of streams, or a curve over several."""
    return _tabulate_curve(report) if "curve" in report else _tabulate_runs(report)


def _tabulate_runs(report: dict[str, Any]) -> Table:
    streams = "1 stream" if report["users"] == 1 else f"{report['users']} streams"
    table = Table(
        "run", "p50", "p99", "p99.9", "max", "in time", "missed", "skipped", "worst user",
        "| pauses", "p99", "in time", "| server µs", "client µs", "MiB",
        title=f"{streams} at 30 Hz for {report['seconds']:g} s, {report['format']}"
        f"{_name_scenarios(report)}",
        caption=f"{_CAPTION}{_describe_besides(report['runs'])}",
        box=None, pad_edge=False, collapse_padding=True,
    )  # fmt: skip
    for number, run in enumerate(report["runs"], start=1):
        latency, clean = run["latency_ms"], run["without_pauses"]
        table.add_row(
            str(number),
            *(_round(latency[name]) for name in ("p50", "p99", "p99_9", "max")),
            _percent(run["within_33_ms"]),
            str(run["misses"]),
            str(run["frames"]["skipped"]),
            _percent(run["fairness"]["worst_user_answered"]),
            f"| {run['host']['pauses']}",
            _round(clean["latency_ms"]["p99"]),
            _percent(clean["within_33_ms"]),
            f"| {_round(run['usage']['server']['us_per_forecast'], 0)}",
            _round(run["usage"]["generator"]["us_per_forecast"], 0),
            _round(run["usage"]["server_memory_mib"]["end"], 0),
        )
    return table


def _name_scenarios(report: dict[str, Any]) -> str:
    return f", with {', '.join(report['with'])}" if report["with"] else ""


def _describe_besides(runs: Sequence[dict[str, Any]]) -> str:
    """Tell what happened in each run besides, line by line."""
    lines = []
    for number, run in enumerate(runs, start=1):
        told = [f"{name.replace('_', ' ')} {count}" for name, count in run["disturbances"].items()]
        if run["clients"]["version_changes"]:
            told.append(f"version changes told {run['clients']['version_changes']}")
        if run["clients"]["came_back"]:
            opening = _round(run["clients"]["opening_ms"]["p99"])
            told.append(f"came back {run['clients']['came_back']}, p99 {opening} ms")
        if "slow_readers" in run:
            slow = run["slow_readers"]
            told.append(
                f"{slow['streams']} slow readers: p99 {_round(slow['latency_ms']['p99'])} ms"
            )
        if told:
            lines.append(f"\n{number}: {' · '.join(told)}")
    return "".join(lines)


def _tabulate_curve(report: dict[str, Any]) -> Table:
    largest = report["largest"]
    table = Table(
        "users", "p50", "p99", "p99.9", "in time", "missed", "skipped", "worst user",
        "| p99", "in time", "| server µs", "client µs", "MiB",
        title=f"{report['seconds']:g} s at 30 Hz, medians of the runs{_name_scenarios(report)}",
        caption=(
            f"{_CAPTION}\nat most {largest['missed_share_at_most']:.1%} missed: up to "
            f"{largest['users'] or 'no'} users; "
            f"{largest['users_without_pauses'] or 'none'} without the machine's pauses"
        ),
        box=None, pad_edge=False, collapse_padding=True,
    )  # fmt: skip
    for row in report["curve"]:
        table.add_row(
            str(row["users"]),
            *(_round(row[name]) for name in ("p50_ms", "p99_ms", "p99_9_ms")),
            _percent(row["within_33_ms"]),
            str(row["misses"]),
            str(row["skipped"]),
            _percent(row["worst_user_answered"]),
            f"| {_round(row['p99_ms_without_pauses'])}",
            _percent(row["within_33_ms_without_pauses"]),
            f"| {_round(row['server_us_per_forecast'], 0)}",
            _round(row["generator_us_per_forecast"], 0),
            _round(row["server_memory_mib"], 0),
        )
    return table


def tabulate_forecast(report: dict[str, Any]) -> Table:
    """Show every way of forecasting, for each number of people."""
    table = Table(
        "people", "way", "forecasts/s", "µs each, median", "p99", "eager", "floor µs", "floor",
        title=f"{report['threads']} thread, {report['cores']} cores", box=None, pad_edge=False,
    )  # fmt: skip
    for row in report["rows"]:
        each = row["us_per_forecast"]
        table.add_row(
            str(row["users"]),
            row["way"],
            str(row["forecasts_per_s"]),
            f"{each['median']:.0f}",
            f"{each['p99']:.0f}",
            f"{row['times_eager']:.1f} x faster",
            "" if row["floor_us"] is None else f"{row['floor_us']:.0f}",
            "" if row["times_floor"] is None else f"{row['times_floor']:.1f} x",
        )
    return table


def tabulate_finetune(report: dict[str, Any]) -> Table:
    """Show how long fine-tuning takes."""
    table = Table(
        "people", "clips", "steps", "seconds, median", "max", "ms per step", "peak MB", "KB each",
        title=f"{report['threads']} thread, {report['cores']} cores", box=None, pad_edge=False,
    )  # fmt: skip
    seconds = report["seconds"]
    table.add_row(
        str(report["users"]),
        str(report["clips"]),
        str(report["steps"]),
        f"{seconds['p50']:.1f}",
        f"{seconds['max']:.1f}",
        f"{report['ms_per_step']:.1f}",
        str(report["peak_memory_mb"]),
        str(report["bytes_per_version"] // 1000),
    )
    return table


def tabulate_memory(report: dict[str, Any]) -> Table:
    """Show the cache at each size, and what one decoder and one user take."""
    users = report["connected_users"]
    told = f"{_round(report['mib_per_decoder'], 2)} MiB for each cached decoder"
    if users is not None:
        told += (
            f"; {_round(users['mib_per_user'], 2)} MiB for each connected user with one "
            f"({users['users']} users: {_round(users['service_mib'], 0)} MiB)"
        )
    table = Table(
        "cached", "MiB", "µs per forecast, p50", "p99", "p99.9",
        title=f"{report['active']} of the cached decoders forecast, one by one",
        caption=told, box=None, pad_edge=False,
    )  # fmt: skip
    for row in report["rows"]:
        each = row["us_per_forecast"]
        table.add_row(
            str(row["decoders"]),
            _round(row["resident_mib"], 0),
            *(_round(each[name], 0) for name in ("p50", "p99", "p99_9")),
        )
    return table


def tabulate_start(report: dict[str, Any]) -> Table:
    """Show how soon a service is ready, and how soon somebody new is foreseen."""
    table = Table(
        "", "median", "p99", "max", "count",
        title=f"{report['starts']} starts with a database that is there already",
        box=None, pad_edge=False,
    )  # fmt: skip
    for name, title, digits in (
        ("ready_s", "ready, s", 2),
        ("first_forecast_ms", "first forecast of a cold user over HTTP, ms", 1),
        ("second_forecast_ms", "their second one, ms", 1),
        ("first_of_stream_ms", "first of a stream, from its opening, ms", 1),
    ):
        spread = report[name]
        figures = (_round(spread[part], digits) for part in ("p50", "p99", "max"))
        table.add_row(title, *figures, str(spread["count"]))
    return table


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{share:.1%}"


def _round(value: float | None, digits: int = 1) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
