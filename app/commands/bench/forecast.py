"""`kinecast bench forecast`: the forecaster alone, many people at once or one by one."""

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from app.commands.figures import summarize
from app.live.decoders import Decoders
from app.main import load_decoders
from models.data.synthetic import SyntheticPerson
from models.spec import MotionSpec

WARM_UP_CALLS = 5


@dataclass(frozen=True, slots=True)
class ForecastPlan:
    """What to measure.

    Attributes:
        users: numbers of people at once.
        repeats: calls of each kind.
        seconds: a kind that takes longer ends after at least `WARM_UP_CALLS` calls.
        threads: of torch's arithmetic.
        model: a checkpoint, None for the shipped one.
    """

    users: Sequence[int]
    repeats: int
    seconds: float
    threads: int
    model: Path | None


def measure_forecast(plan: ForecastPlan) -> dict[str, Any]:
    """Time batches, and the same windows one by one.

    Raises:
        StartError: the weights cannot be loaded.
    """
    torch.set_num_threads(plan.threads)
    torch.set_flush_denormal(True)
    decoders = load_decoders(plan.model)
    rows = []
    for users in plan.users:
        windows = invent_windows(users)
        rows += [
            _measure(plan, windows, mode="batch", call=decoders.forecast),
            _measure(plan, windows, mode="one_by_one", call=_one_by_one(decoders)),
        ]
    return {
        "benchmark": "forecast",
        "model_sha256": decoders.base_sha256,
        "threads": plan.threads,
        "cores": os.cpu_count(),
        "load_average": [round(load, 2) for load in os.getloadavg()],
        "rows": rows,
    }


def invent_windows(users: int) -> Float[np.ndarray, "user 15 20 3"]:
    """Make one window of each of some people, float64 as the live flow has them."""
    spec = MotionSpec()
    seconds = spec.observe / spec.rate_hz
    people = [SyntheticPerson(seed).record("walk", seconds) for seed in range(users)]
    return np.stack(people).astype(np.float64)


def _one_by_one(decoders: Decoders) -> Callable[[Float[np.ndarray, "user 15 20 3"]], object]:
    def call(windows: Float[np.ndarray, "user 15 20 3"]) -> object:
        return [decoders.forecast(windows[i : i + 1]) for i in range(len(windows))]

    return call


def _measure(
    plan: ForecastPlan,
    windows: Float[np.ndarray, "user 15 20 3"],
    *,
    mode: str,
    call: Callable[[Float[np.ndarray, "user 15 20 3"]], object],
) -> dict[str, Any]:
    """Time one way of forecasting some windows."""
    for _ in range(WARM_UP_CALLS):
        call(windows)
    taken_us: list[float] = []
    deadline = time.perf_counter() + plan.seconds
    while len(taken_us) < plan.repeats:
        begin = time.perf_counter()
        call(windows)
        end = time.perf_counter()
        taken_us.append((end - begin) / len(windows) * 1e6)
        if end > deadline and len(taken_us) >= WARM_UP_CALLS:
            break
    spread = summarize(taken_us)
    low, high = np.percentile(taken_us, (25, 75))
    return {
        "users": len(windows),
        "mode": mode,
        "calls": len(taken_us),
        "forecasts_per_s": round(1e6 / spread.median),
        "us_per_forecast": {
            "median": round(spread.median, 1),
            "p99": round(spread.p99, 1),
            "quartiles": [round(float(low), 1), round(float(high), 1)],
        },
        "ms_per_call": round(spread.median * len(windows) / 1e3, 3),
    }
