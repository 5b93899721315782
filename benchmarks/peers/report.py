"""The figures of all rows: what was left out, medians, and the table."""

from collections.abc import Iterable, Mapping, Sequence
from importlib import metadata
from importlib.util import find_spec
from statistics import median
from typing import Any

PACKAGES = ("torch", "litserve", "ray", "fastapi", "uvicorn", "websockets")
COLUMNS = ("forecasts_per_s", "p50_ms", "p99_ms", "processor_ms")
EXTRA = "pip install -e '.[peers]'"


def explain_missing(package: str | None) -> str | None:
    """Say why a row cannot be measured; None if it can."""
    if package is None or find_spec(package) is not None:
        return None
    return f"{package} is not installed; `{EXTRA}` installs it"


def list_versions(packages: Iterable[str] = PACKAGES) -> dict[str, str | None]:
    """Give the versions of packages; None for what is not installed."""
    installed: dict[str, str | None] = {}
    for package in packages:
        try:
            installed[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            installed[package] = None
    return installed


def summarise_runs(runs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Give the median of the repetitions and how far they are apart."""
    return {
        "forecasts_per_s": _spread(run["forecasts_per_s"] for run in runs),
        "p50_ms": _spread(run["latency_ms"]["p50"] for run in runs),
        "p99_ms": _spread(run["latency_ms"]["p99"] for run in runs),
        "processor_ms": _spread(run["processor_ms"] for run in runs),
    }


def _spread(values: Iterable[float | None]) -> dict[str, float] | None:
    """Give median, lowest and highest of what is known; None for nothing."""
    known = [value for value in values if value is not None]
    if not known:
        return None
    return {"median": median(known), "lowest": min(known), "highest": max(known)}


def tabulate(rows: Sequence[Mapping[str, Any]]) -> str:
    """Draw the table; the last row of each number of people is what the others are held against."""
    lines = [
        "| people | clients | served by | forecasts per s | p50 ms | p99 ms | processor ms "
        "| last row ÷ this |",
        "|---|---|---|---|---|---|---|---|",
    ]
    last = {row["people"]: row["forecasts_per_s"]["median"] for row in rows}
    for row in rows:
        rate = row["forecasts_per_s"]["median"]
        times = f"{last[row['people']] / rate:.1f}" if rate else ""
        cells = (_show(row[name]) for name in COLUMNS)
        start = f"| {row['people']} | {row['clients']} | {row['way']} "
        lines.append(f"{start}| {' | '.join(cells)} | {times} |")
    return "\n".join(lines)


def _show(spread: Mapping[str, float] | None) -> str:
    """Write a median with the lowest and the highest of the repetitions."""
    if spread is None:
        return ""
    digits = 0 if spread["median"] >= 100 else 1 if spread["median"] >= 10 else 2
    told = [f"{spread[name]:.{digits}f}" for name in ("median", "lowest", "highest")]
    return f"{told[0]} ({told[1]} to {told[2]})"
