"""`kinecast bench forecast`: forecasts alone, by everybody's own decoder, in every way there is."""

import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from app.commands.bench.floor import Floor, measure_floor
from app.commands.bench.residents import vary
from app.commands.figures import summarize
from models.arithmetic import arithmetic
from models.checkpoint import SHIPPED, load_checkpoint
from models.correction import Correction
from models.data.synthetic import SyntheticPerson
from models.familiarity import Familiarity, FamiliarityRule
from models.personal import PersonalDecoder
from models.predictor import Predictor
from models.runtime.fused import PROCESSORS, PackedPerson, find_packed, forecast_fused
from models.runtime.mixed import forecast_mixed
from models.runtime.pack import (
    KINDS,
    Kind,
    Packed,
    PackedBase,
    pack_correction,
    pack_decoder,
    pack_gate,
)
from models.runtime.stacked import Stack, StackedDecoder, find_device
from models.spec import MotionSpec

WARM_UP_CALLS = 3
LEAST_CALLS = 5
KNOWN_WINDOWS = 1000
"""Of a trial of 27 clips."""
FAMILIES = 16
"""Different decoders in torch; with more people than that, torch's copies are shared."""

Windows = Float[np.ndarray, "user 15 20 3"]
Call = Callable[[Windows], object]


@dataclass(frozen=True, slots=True)
class ForecastPlan:
    """What to measure.

    Attributes:
        users: numbers of people at once.
        repeats: calls of each kind.
        seconds: a kind that takes longer ends after at least `LEAST_CALLS` calls.
        threads: of torch's arithmetic.
        model: a checkpoint, None for the shipped one.
    """

    users: Sequence[int]
    repeats: int
    seconds: float
    threads: int
    model: Path | None


@dataclass(frozen=True, eq=False)
class People:
    """Everybody's decoder, in the forms that the ways of forecasting want.

    All but `served` are decoders alone; those have a gate and a correction, as versions do.
    """

    base: Predictor
    packed_base: PackedBase | None
    torch: Sequence[PersonalDecoder]
    packed: Mapping[Kind, Sequence[PackedPerson]]
    served: Sequence[PackedPerson]
    stack: Stack
    stacked: Sequence[StackedDecoder]


def measure_forecast(plan: ForecastPlan) -> dict[str, Any]:
    """Time every way of forecasting some people at once, in the same run.

    Raises:
        CheckpointError: the weights cannot be loaded.
        OSError: they cannot be read.
    """
    checkpoint = load_checkpoint(plan.model or SHIPPED)
    with arithmetic(plan.threads), torch.inference_mode():
        people = invent_people(checkpoint.predictor, max(plan.users))
        floor = None if people.packed_base is None else measure_floor(people.packed_base)
        rows = [row for users in plan.users for row in _measure_users(plan, people, users, floor)]
    return {
        "benchmark": "forecast",
        "model_sha256": checkpoint.sha256,
        "threads": plan.threads,
        "cores": os.cpu_count(),
        "load_average": [round(load, 2) for load in os.getloadavg()],
        "floor": None if floor is None else floor.as_json(),
        "rows": rows,
    }


def invent_people(base: Predictor, users: int) -> People:
    """Give everybody a decoder near the base's; speed depends on sizes, not on what was learnt."""
    packed = find_packed(base)
    decoders: list[PersonalDecoder] = []
    forms: dict[Kind, list[PackedPerson]] = {kind: [] for kind in KINDS if packed is not None}
    for user, decoder in zip(range(users), vary(base.decoder), strict=False):
        if user < FAMILIES:
            decoders.append(PersonalDecoder(base, decoder, None, {}))
        for kind, people in forms.items():
            people.append(PackedPerson(pack_decoder(decoder, kind=kind), None))
    stack = Stack(base, find_device("auto") or "cpu")
    stacked = [stack.add(one) for one in decoders]
    rest = _invent_rest(base)
    served = [replace(person, **rest()) for person in forms.get("bfloat16", ())]
    return People(base, packed, decoders, forms, served, stack, stacked)


def _invent_rest(base: Predictor) -> Callable[[], dict[str, Packed]]:
    """Make a gate that finds everything familiar and a correction, of a trial of a usual size.

    Each call gives copies of their own, so that no two people share what a processor keeps near.
    """
    random = torch.Generator().manual_seed(0)
    z = torch.randn(KNOWN_WINDOWS, base.config.continuous, generator=random)
    gate = Familiarity.fit(z, FamiliarityRule(half=1e3))
    coordinates = 3 * base.spec.horizon * base.spec.joints
    missed = torch.randn(KNOWN_WINDOWS, coordinates, generator=random)
    correction = Correction.fit(gate, z, missed)
    return lambda: {"gate": pack_gate(gate), "correction": pack_correction(correction)}


def invent_windows(users: int) -> Windows:
    """Make one window of each of some people, float64 as the live flow has them."""
    spec = MotionSpec()
    seconds = spec.observe / spec.rate_hz
    people = [SyntheticPerson(seed % 64).record("walk", seconds) for seed in range(users)]
    return np.stack(people).astype(np.float64)


def _measure_users(
    plan: ForecastPlan, people: People, users: int, floor: Floor | None
) -> list[dict[str, Any]]:
    windows = invent_windows(users)
    ways: dict[str, Call] = {
        "eager": partial(_one_after_another, people),
        "torch": partial(_batch, people),
    }
    ways[f"stacked {people.stack.device.type}"] = partial(_stack, people)
    if people.packed_base is not None:
        for processor in PROCESSORS:
            for kind, packed in people.packed.items():
                call = partial(_fuse, people.packed_base, packed[:users], processor)
                ways[f"{processor} {kind}"] = call
            served = people.served[:users]
            ways[f"{processor} served"] = partial(_fuse, people.packed_base, served, processor)
    rows = [_measure(plan, windows, way=way, call=call) for way, call in ways.items()]
    eager = rows[0]["us_per_forecast"]["median"]
    for row in rows:
        median = row["us_per_forecast"]["median"]
        row["times_eager"] = round(eager / median, 1)
        least = None if floor is None else floor.find(row["way"], users)
        row["floor_us"] = None if least is None else round(least, 1)
        row["times_floor"] = None if least is None else round(median / least, 2)
    return rows


def _one_after_another(people: People, windows: Windows) -> object:
    """Forecast as PyTorch does by itself: one person, then the next."""
    given = torch.from_numpy(windows.astype(np.float32))
    own = people.torch
    return [own[i % len(own)](given[i : i + 1]) for i in range(len(given))]


def _batch(people: People, windows: Windows) -> object:
    """Forecast by PyTorch, with the encoder batched."""
    given = torch.from_numpy(windows.astype(np.float32))
    own = people.torch
    return forecast_mixed(people.base, given, [own[i % len(own)] for i in range(len(given))])


def _stack(people: People, windows: Windows) -> object:
    """Forecast by stacked products: on a GPU where there is one."""
    own = people.stacked
    return people.stack.forecast(windows, [own[i % len(own)] for i in range(len(windows))])


def _fuse(
    base: PackedBase, packed: Sequence[PackedPerson], processor: str, windows: Windows
) -> object:
    return forecast_fused(base, windows, packed, processor=processor)


def _measure(plan: ForecastPlan, windows: Windows, *, way: str, call: Call) -> dict[str, Any]:
    """Time one way of forecasting some windows."""
    deadline = time.perf_counter() + plan.seconds
    for _ in range(WARM_UP_CALLS):
        call(windows)
    taken_us: list[float] = []
    while len(taken_us) < plan.repeats:
        begin = time.perf_counter()
        call(windows)
        end = time.perf_counter()
        taken_us.append((end - begin) / len(windows) * 1e6)
        if end > deadline and len(taken_us) >= LEAST_CALLS:
            break
    spread = summarize(taken_us)
    low, high = np.percentile(taken_us, (25, 75))
    return {
        "users": len(windows),
        "way": way,
        "calls": len(taken_us),
        "forecasts_per_s": round(1e6 / spread.median),
        "us_per_forecast": {
            "median": round(spread.median, 1),
            "p99": round(spread.p99, 1),
            "quartiles": [round(float(low), 1), round(float(high), 1)],
        },
        "ms_per_call": round(spread.median * len(windows) / 1e3, 3),
    }
