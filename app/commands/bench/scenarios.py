"""What else may happen while people stream: `kinecast bench stream --with`.

Clients that come and go, and those that read slowly, belong to the load and are driven here; what
reaches the service from elsewhere is in `app.commands.bench.disturbance`.
"""

import asyncio
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from enum import StrEnum

from app.commands.bench.client import BenchClient


class Scenario(StrEnum):
    """What happens besides."""

    SWAPS = "swaps"
    CHURN = "churn"
    SLOW = "slow"
    FINETUNE = "finetune"


CHURN_SHARE = 0.05
"""So many of the users leave in every second, but at least one."""
AWAY_S = 0.5
SLOW_SHARE = 0.1
DEAF_S, LISTEN_S = 1.0, 1.0
"""How long slow readers read nothing, and how long they read in between."""
SLOW_RECEIVE_BYTES = 16_384
"""What the system holds for a slow reader, so that the service notices that nobody reads."""


def read_scenarios(text: str) -> frozenset[Scenario]:
    """Read names with commas between them.

    Raises:
        ValueError: there is no scenario of such a name.
    """
    return frozenset(Scenario(name.strip()) for name in text.split(",") if name.strip())


def choose_slow(users: int, scenarios: frozenset[Scenario]) -> frozenset[int]:
    """Choose who reads slowly, by number, evenly spread; nobody where that is not asked for."""
    if Scenario.SLOW not in scenarios:
        return frozenset()
    count = max(1, round(SLOW_SHARE * users))
    return frozenset(i * users // count for i in range(count))


@contextmanager
def happening(
    clients: Sequence[BenchClient], scenarios: frozenset[Scenario]
) -> Iterator[list["asyncio.Task[None]"]]:
    """Let things happen to clients until the block ends; the tasks end before only by an error."""
    ordinary = [client for client in clients if not client.log.slow]
    slow = [client for client in clients if client.log.slow]
    parts = [read_slowly(client, n / len(slow)) for n, client in enumerate(slow)]
    if Scenario.CHURN in scenarios and ordinary:
        parts.append(come_and_go(ordinary))
    tasks = [asyncio.create_task(part) for part in parts]
    try:
        yield tasks
    finally:
        for task in tasks:
            task.cancel()


async def read_slowly(client: BenchClient, phase: float) -> None:
    """Stop reading again and again.

    Args:
        client: who does.
        phase: when in its cycle it begins, 0 … 1.
    """
    await asyncio.sleep(phase * (DEAF_S + LISTEN_S))
    while True:
        client.pause()
        try:
            await asyncio.sleep(DEAF_S)
        finally:
            client.resume()
        await asyncio.sleep(LISTEN_S)


async def come_and_go(clients: Sequence[BenchClient]) -> None:
    """Let one after the other leave and come back a little later.

    Raises:
        ClientError: somebody could not come back.
    """
    pause_s = 1 / max(1.0, CHURN_SHARE * len(clients))
    async with asyncio.TaskGroup() as group:
        turn = 0
        while True:
            due = time.monotonic() + pause_s
            group.create_task(_leave_for_a_while(clients[turn % len(clients)]))
            turn += 1
            await asyncio.sleep(max(0.0, due - time.monotonic()))


async def _leave_for_a_while(client: BenchClient) -> None:
    if not client.is_there:
        return
    client.leave()
    await client.close()
    await asyncio.sleep(AWAY_S)
    begin = time.monotonic()
    await client.open()
    client.log.opened_s.append(time.monotonic() - begin)
