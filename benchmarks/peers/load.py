"""A closed loop: so many clients, each of which asks again as soon as it has its answer."""

import asyncio
import gc
import time
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from typing import Any

from app.commands.client.together import run_together
from app.commands.figures import summarize
from benchmarks.peers.people import Poses

SPARE_S = 300.0
"""Longest time by which a run may be late, on a machine that pauses."""

Ask = Callable[[], Awaitable[Poses]]
"""One request of one client; gives the forecast."""


@dataclass(frozen=True, slots=True)
class Run:
    """What a run gave.

    Attributes:
        seconds: how long it was.
        asked: answers, some of which came after its end.
        latencies_ms: of the answers that came in time.
    """

    seconds: float
    asked: int
    latencies_ms: Sequence[float]

    def as_json(self) -> dict[str, Any]:
        """Give the figures of the run."""
        return {
            "forecasts_per_s": round(len(self.latencies_ms) / self.seconds, 1),
            "latency_ms": summarize(self.latencies_ms).as_json(),
        }


async def run_closed(clients: Sequence[Ask], seconds: float) -> Run:
    """Let all clients ask for so long; what arrives later does not count.

    Raises:
        TimeoutError: the answers do not come.
    """
    latencies_ms: list[float] = []
    gc.collect()
    async with asyncio.timeout(seconds + SPARE_S):
        end = time.perf_counter() + seconds
        await run_together(*(_repeat(client, end, latencies_ms) for client in clients))
    return Run(seconds, len(latencies_ms) + len(clients), latencies_ms)


async def _repeat(ask: Ask, end: float, latencies_ms: list[float]) -> None:
    begin = time.perf_counter()
    while begin < end:
        await ask()
        arrived = time.perf_counter()
        if arrived <= end:
            latencies_ms.append((arrived - begin) * 1e3)
        begin = arrived
