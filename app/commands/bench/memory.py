"""`kinecast bench memory`: what a user and a cached decoder take, and what many cost.

The decoders are built and kept as the service does it, in this process: from the bytes that the
database holds, on the shelf that holds all that are in use.
"""

import ctypes
import gc
import hashlib
import os
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import torch

from app.commands.bench.forecast import Windows, invent_windows
from app.commands.bench.residents import vary
from app.commands.bench.stream import StreamPlan, measure_stream, own_subject
from app.commands.bench.usage import read_resident_mib
from app.commands.figures import summarize
from app.live.decoders import Decoders
from app.live.shelf import Shelf
from models.arithmetic import arithmetic
from models.baselines import Forecaster
from models.checkpoint import SHIPPED, dump_personal, load_checkpoint
from models.rounding import round_matrices

STREAM_S = 3.0
_FIND_EVERY = 500

Progress = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class MemoryPlan:
    """What to measure.

    Attributes:
        decoders: numbers of cached decoders, rising.
        active: how many of them forecast.
        rounds: forecasts of each of those, for each number.
        users: streams for the memory of a connected user; 0: leave that out.
        model: a checkpoint, None for the shipped one.
    """

    decoders: Sequence[int]
    active: int
    rounds: int
    users: int
    model: Path | None


def measure_memory(plan: MemoryPlan, *, progress: Progress = lambda _: None) -> dict[str, Any]:
    """Fill the cache step by step, and time the same number of people at each.

    Raises:
        ClientError: the service for the streams refuses.
        OwnServerError: it does not start.
    """
    users = _measure_users(plan.users, progress) if plan.users else None
    with arithmetic(1), torch.inference_mode():
        rows = _fill(plan, progress)
    first, last = rows[0], rows[-1]
    grown = last["decoders"] - first["decoders"]
    return {
        "benchmark": "memory",
        "cores": os.cpu_count(),
        "load_average": [round(load, 2) for load in os.getloadavg()],
        "active": plan.active,
        "rows": rows,
        "mib_per_decoder": _divide(last["resident_mib"], first["resident_mib"], grown),
        "slowdown": round(last["us_per_forecast"]["p50"] / first["us_per_forecast"]["p50"], 3),
        "connected_users": users,
    }


def _measure_users(users: int, progress: Progress) -> dict[str, Any]:
    """Give the memory that the service takes with one stream and with many."""
    plan = StreamPlan(users=(1, users), seconds=STREAM_S, repeats=1, form="msgpack")
    with own_subject(users) as subject:
        curve = measure_stream(plan, subject, progress=progress)["curve"]
    one, many = (row["server_memory_mib"] for row in curve)
    return {
        "users": users,
        "service_mib_with_one": one,
        "service_mib": many,
        "mib_per_user": _divide(many, one, users - 1),
    }


def _fill(plan: MemoryPlan, progress: Progress) -> list[dict[str, Any]]:
    checkpoint = load_checkpoint(plan.model or SHIPPED)
    base = checkpoint.predictor
    decoders = Decoders(base, base_sha256=checkpoint.sha256, radius=checkpoint.radius)
    shelf, kept, rows = Shelf(), list[str](), list[dict[str, Any]]()
    in_use: list[Forecaster] = []
    windows = invent_windows(plan.active)
    personal = vary(base.decoder)
    for goal in plan.decoders:
        for decoder in islice(personal, goal - len(kept)):
            round_matrices(decoder)
            blob = dump_personal(decoder, {"radius_scale": 1.0}, base_sha256=checkpoint.sha256)
            digest = hashlib.sha256(blob).hexdigest()
            in_use.append(decoders.build(blob))
            shelf.put(digest, in_use[-1])
            kept.append(digest)
            if len(kept) % _FIND_EVERY == 0:
                progress(f"{len(kept)} of {plan.decoders[-1]} decoders built")
        shelf.tidy(kept)
        progress(f"forecasting with {goal} cached decoders")
        rows.append(_measure(decoders, shelf, kept, windows, plan.rounds))
    return rows


def _measure(
    decoders: Decoders, shelf: Shelf, kept: Sequence[str], windows: Windows, rounds: int
) -> dict[str, Any]:
    """Time forecasts one by one, of people who are evenly spread over the cache."""
    active = [kept[i * len(kept) // len(windows)] for i in range(len(windows))]
    taken_us: list[float] = []
    for turn in range(rounds + 1):
        for row, digest in enumerate(active):
            begin = time.perf_counter()
            outcomes = decoders.forecast_each(windows[row : row + 1], [shelf.find(digest)])
            if turn:  # the first one fetches everything from where it was left
                taken_us.append((time.perf_counter() - begin) * 1e6)
            if isinstance(outcomes[0], Exception):
                raise outcomes[0]
    _give_back()
    return {
        "decoders": len(shelf.list_digests()),
        "resident_mib": read_resident_mib(os.getpid()),
        "us_per_forecast": summarize(taken_us).as_json(),
    }


def _give_back() -> None:
    """Return what is free to the system, so that only what is held is counted."""
    gc.collect()
    with suppress(OSError, AttributeError):  # where there is no glibc, a little more is counted
        ctypes.CDLL("libc.so.6").malloc_trim(0)


def _divide(after: float | None, before: float | None, count: int) -> float | None:
    if after is None or before is None or count < 1:
        return None
    return round((after - before) / count, 3)
