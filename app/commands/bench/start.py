"""`kinecast bench start`: how soon a service is ready, and how soon somebody new is foreseen."""

import asyncio
import os
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from app.commands.bench.clockwork import run_precisely
from app.commands.bench.residents import find_settings, give_versions
from app.commands.client.errors import SilenceError
from app.commands.client.messages import Forecast
from app.commands.client.rest import Api
from app.commands.client.stream import open_stream
from app.commands.figures import summarize
from app.commands.own_server import run_own_server
from models.data.synthetic import SyntheticPerson

RATE_HZ = 30.0
OBSERVED = 15
WAIT_S = 10.0

Progress = Callable[[str], None]
Poses = Float64[np.ndarray, "15 20 3"]


@dataclass(frozen=True, slots=True)
class StartPlan:
    """What to measure.

    Attributes:
        starts: how often the service is started, with a database that is there already.
        users: cold people in each start, for each of the two ways to ask.
    """

    starts: int
    users: int


def measure_start(plan: StartPlan, *, progress: Progress = lambda _: None) -> dict[str, Any]:
    """Start a service again and again, and let people ask whose decoders it has never held.

    Raises:
        ClientError: the service cannot be reached, or refuses.
        OwnServerError: it does not start.
    """
    ready_s: list[float] = []
    taken_ms: dict[str, list[float]] = {"rest": [], "rest_again": [], "stream": []}
    with tempfile.TemporaryDirectory(prefix="kinecast-bench-") as name:
        folder, users = Path(name), [f"bench-{n}" for n in range(2 * plan.users)]
        progress("first start, which makes the database")
        with run_own_server(folder, log_level="warning") as server:
            asyncio.run(_add_users(server.url, server.key, users))
            give_versions(find_settings(folder), users)
        for number in range(1, plan.starts + 1):
            progress(f"start {number} of {plan.starts}")
            begin = time.monotonic()
            with run_own_server(folder, log_level="warning") as server:
                ready_s.append(time.monotonic() - begin)
                asking = _ask_all(server.url, server.key, users, taken_ms)
                run_precisely(asking)
    return {
        "benchmark": "start",
        "cores": os.cpu_count(),
        "load_average": [round(load, 2) for load in os.getloadavg()],
        "starts": plan.starts,
        "users": plan.users,
        "ready_s": summarize(ready_s).as_json(),
        "first_forecast_ms": summarize(taken_ms["rest"]).as_json(),
        "second_forecast_ms": summarize(taken_ms["rest_again"]).as_json(),
        "first_of_stream_ms": summarize(taken_ms["stream"]).as_json(),
    }


async def _add_users(url: str, key: str, users: Sequence[str]) -> None:
    async with Api(url, key=key) as api:
        for user in users:
            await api.add_user(user)


async def _ask_all(
    url: str, key: str, users: Sequence[str], taken_ms: dict[str, list[float]]
) -> None:
    """Let half of the people ask twice by REST, and the others open a stream."""
    poses = SyntheticPerson(0).record("walk", OBSERVED / RATE_HZ).astype(np.float64)
    half = len(users) // 2
    async with Api(url, key=key) as api:
        await api.is_ready()  # opens the connection
        for user in users[:half]:
            for name in ("rest", "rest_again"):
                begin = time.monotonic()
                forecast = await api.forecast(user, poses)
                taken_ms[name].append((time.monotonic() - begin) * 1e3)
                _demand_personal(forecast.version.kind)
    for user in users[half:]:
        taken_ms["stream"].append(await _await_first(url, key, user, poses))


async def _await_first(url: str, key: str, user: str, poses: Poses) -> float:
    """Open a stream with half a second of frames; gives milliseconds to the first forecast."""
    begin = time.monotonic()
    async with open_stream(url, user, key=key) as stream:
        for seq, pose in enumerate(poses):
            await stream.send_frame(seq, begin + (seq - OBSERVED) / RATE_HZ, pose)
        while time.monotonic() - begin < WAIT_S:
            message = await stream.receive()
            if isinstance(message, Forecast):
                _demand_personal(message.version.kind)
                return (time.monotonic() - begin) * 1e3
    raise SilenceError(f"No forecast came for {WAIT_S:g} s.")


def _demand_personal(kind: str) -> None:
    if kind != "personal":
        raise SilenceError(f"A forecast by {kind} came, and none by the user's own decoder.")
