"""What a load costs: processor time of both sides, and the memory of the service."""

import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

_PROC = Path("/proc")
_MIB = 1 << 20


@dataclass(frozen=True, slots=True)
class Sample:
    """Where the counters stood.

    Attributes:
        at: on the clock of `time.monotonic`.
        generator_s: processor time of the thread that makes the load.
        server_s: processor time of the service and all its threads, None where it is not ours.
        server_mib: resident memory of the service.
    """

    at: float
    generator_s: float
    server_s: float | None
    server_mib: float | None


def take_sample(server: int | None) -> Sample:
    """Read the counters, in the thread that makes the load.

    Args:
        server: process of the service; None: it is not ours.
    """
    return Sample(
        at=time.monotonic(),
        generator_s=time.thread_time(),
        server_s=None if server is None else read_cpu_s(server),
        server_mib=None if server is None else read_resident_mib(server),
    )


def describe_usage(begin: Sample, end: Sample, *, forecasts: int) -> dict[str, Any]:
    """Give the cost of what was forecast between two samples; null where it is not known."""
    elapsed = end.at - begin.at

    def tell(before: float | None, after: float | None) -> dict[str, float | None]:
        if before is None or after is None:
            return {"us_per_forecast": None, "cores": None}
        taken = after - before
        each = round(taken * 1e6 / forecasts, 1) if forecasts else None
        return {"us_per_forecast": each, "cores": round(taken / elapsed, 3)}

    return {
        "server": tell(begin.server_s, end.server_s),
        "generator": tell(begin.generator_s, end.generator_s),
        "server_memory_mib": {"begin": begin.server_mib, "end": end.server_mib},
    }


def read_cpu_s(process: int) -> float | None:
    """Give the processor time of a process with all its threads; None where it cannot be read."""
    try:
        content = (_PROC / str(process) / "stat").read_text()
        user, system = content.rpartition(")")[2].split()[11:13]
        return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")
    except (OSError, ValueError):
        return None


def read_resident_mib(process: int) -> float | None:
    """Give the resident memory of a process; None where it cannot be read."""
    try:
        pages = int((_PROC / str(process) / "statm").read_text().split()[1])
    except (OSError, ValueError, IndexError):
        return None
    return round(pages * os.sysconf("SC_PAGE_SIZE") / _MIB, 1)
