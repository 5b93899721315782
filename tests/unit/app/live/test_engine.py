import asyncio
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future

import numpy as np
import pytest
import torch
from torch import Tensor

from app.domain.errors import DrainingError, OverloadedError, VersionUnavailableError
from app.live.decoders import Decoders
from app.live.engine import Engine
from app.live.telemetry import Telemetry
from app.live.work import EngineRequest, EngineResult
from models.baselines import DampedVelocity, ZeroVelocity
from models.data.synthetic import SyntheticPerson
from models.predictor import Predictor
from models.uncertainty import LEVELS, RadiusTable

PERSON = SyntheticPerson(4).record("walk", 4.0).astype(np.float64)
RADIUS = RadiusTable(np.cumsum(np.ones((len(LEVELS), 15, 20), np.float32), axis=0))


def request(start: int = 0, shift: float = 0.0) -> EngineRequest:
    return EngineRequest(PERSON[start : start + 15] + shift, "active", 0.9)


class Gate:
    """A forecaster that waits for permission, and counts."""

    def __init__(self) -> None:
        self.open = threading.Event()
        self.open.set()
        self.batches: list[int] = []

    def __call__(self, window: Tensor) -> Tensor:
        assert self.open.wait(10)
        self.batches.append(len(window))
        return ZeroVelocity(15)(window)


StartEngine = Callable[..., Engine]


@pytest.fixture
def start() -> Iterator[StartEngine]:
    engines = []

    def begin(forecaster: object = None, **options: object) -> Engine:
        decoders = Decoders(forecaster or DampedVelocity(15), base_sha256="ab", radius=RADIUS)
        engine = Engine(decoders, **({"batch": 8} | options))
        engines.append(engine)
        engine.start()
        engine.wait_ready(10.0)
        return engine

    yield begin
    for engine in engines:
        engine.stop()


def result_of(future: "Future[EngineResult]") -> EngineResult:
    return future.result(10)


def test_a_forecast_is_a_displacement_with_its_origin(start) -> None:
    engine = start()
    assert engine.is_ready
    result = result_of(engine.submit(request()))
    velocity = PERSON[14] - PERSON[13]
    np.testing.assert_allclose(
        result.displacement[0], DampedVelocity(15).decay * velocity, atol=1e-6
    )
    assert (result.version.number, result.version.sha256) == (0, "ab")
    np.testing.assert_allclose(result.radius, RADIUS.radius(0.9))
    assert result.flags == ()
    assert result.timing.total_ms >= result.timing.compute_ms >= 0


def test_the_place_of_the_person_costs_no_precision(start) -> None:
    engine = start()
    here, there = (result_of(engine.submit(request(shift=shift))) for shift in (0.0, 90.0))
    np.testing.assert_allclose(here.displacement, there.displacement, atol=1e-6)


def test_a_window_alone_and_in_a_batch_give_the_same(start) -> None:
    torch.manual_seed(0)
    net = Predictor().eval().requires_grad_(requires_grad=False)
    gate = Gate()

    def gated(window: Tensor) -> Tensor:
        gate(window)
        return net(window)

    engine = start(gated)
    alone = [result_of(engine.submit(request(i))) for i in range(5)]
    gate.open.clear()
    futures = [engine.submit(request(i)) for i in (0, *range(5))]
    gate.open.set()
    batched = [result_of(future) for future in futures][1:]
    assert max(gate.batches) >= 5
    for one, other in zip(alone, batched, strict=True):
        assert one.version.kind == other.version.kind == "base"
        np.testing.assert_allclose(one.displacement, other.displacement, atol=1e-4)


def test_only_the_newest_window_of_a_slot_is_forecast(start) -> None:
    gate = Gate()
    engine = start(gate)
    gate.open.clear()
    blocker = engine.submit(request())
    time.sleep(0.05)
    slot, other = engine.open_slot(), engine.open_slot()
    done: list[str] = []
    finished = threading.Event()
    superseded = [slot.put(request(i), lambda _, i=i: done.append(f"a{i}")) for i in range(3)]
    other.put(request(9), lambda _: (done.append("b"), finished.set()))
    closed = engine.open_slot()
    closed.put(request(1), lambda _: done.append("closed"))
    closed.close()
    gate.open.set()
    result_of(blocker)
    assert finished.wait(10)
    assert superseded == [0, 1, 1]
    assert done == ["a2", "b"]
    assert gate.batches[-1] == 2


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 50.0])
def test_an_impossible_forecast_is_replaced_for_that_window_only(start, value: float) -> None:
    def raving(window: Tensor) -> Tensor:
        forecast = ZeroVelocity(15)(window)
        is_odd = window[:, 0, 0, 1] > 5
        forecast[is_odd, 7, 3] = value
        return forecast

    gate = Gate()

    def gated(window: Tensor) -> Tensor:
        gate(window)
        return raving(window)

    telemetry = Telemetry()
    engine = start(gated, telemetry=telemetry)
    odd = PERSON[:15].copy()
    odd[0, 0, 1] += 10
    gate.open.clear()
    futures = [
        engine.submit(one) for one in (request(), EngineRequest(odd, "base", 0.9), request())
    ]
    gate.open.set()
    first, bad, last = (result_of(future) for future in futures)
    assert first.version.kind == last.version.kind == "base"
    assert (bad.version.kind, bad.version.fallback) == ("damped_velocity", "guard")
    assert (bad.version.number, bad.version.sha256, bad.version.share) == (None, None, 0.0)
    assert bad.version.requested == "base"
    assert bad.radius is None
    assert bad.flags == ("fallback", "uncalibrated")
    assert b'kinecast_fallbacks_total{reason="guard"} 1.0' in telemetry.render()


def test_an_exception_of_the_net_hits_its_window_only(start) -> None:
    def moody(window: Tensor) -> Tensor:
        if (window[:, 0, 0, 1] > 5).any():
            raise RuntimeError("no")
        return ZeroVelocity(15)(window)

    engine = start(moody)
    odd = PERSON[:15].copy()
    odd[0, 0, 1] += 10
    futures = [engine.submit(one) for one in (request(), EngineRequest(odd, "active", 0.9))]
    good, bad = (result_of(future) for future in futures)
    assert good.version.fallback is None
    assert (bad.version.kind, bad.version.fallback) == ("damped_velocity", "engine_error")
    assert np.isfinite(bad.displacement).all()


def test_a_person_who_leaps_stands_still_in_the_fallback(start) -> None:
    def broken(window: Tensor) -> Tensor:
        raise RuntimeError("no")

    engine = start(broken)
    assert not engine.is_ready
    leap = PERSON[:15].copy()
    leap[-1] += 5.0
    result = result_of(engine.submit(EngineRequest(leap, "active", 0.9)))
    assert (result.version.kind, result.version.fallback) == ("zero_velocity", "engine_error")
    assert not result.displacement.any()


def test_single_forecasts_are_bounded(start) -> None:
    gate = Gate()
    engine = start(gate, queue=3)
    gate.open.clear()
    futures = [engine.submit(request()) for _ in range(3)]
    with pytest.raises(OverloadedError):
        engine.submit(request())
    gate.open.set()
    for future in futures:
        result_of(future)
    result_of(engine.submit(request()))


def test_whoever_waits_when_the_engine_stops_is_told(start) -> None:
    gate = Gate()
    engine = start(gate)
    gate.open.clear()
    in_hand = engine.submit(request())
    time.sleep(0.05)
    waiting = [engine.submit(request()) for _ in range(3)]
    stopper = threading.Thread(target=engine.stop)
    stopper.start()
    time.sleep(0.05)
    gate.open.set()
    stopper.join(10)
    result_of(in_hand)
    for future in waiting:
        assert isinstance(future.exception(10), DrainingError)
    with pytest.raises(DrainingError):
        engine.submit(request())
    assert not engine.is_ready


def test_a_caller_that_gave_up_harms_nobody(start) -> None:
    gate = Gate()
    engine = start(gate)
    gate.open.clear()
    first, second = engine.submit(request()), engine.submit(request())
    assert second.cancel()
    slot = engine.open_slot()

    def closed_loop(_: EngineResult) -> None:
        raise RuntimeError("Event loop is closed")

    slot.put(request(), closed_loop)
    gate.open.set()
    result_of(first)
    result_of(engine.submit(request()))


@pytest.mark.asyncio
async def test_forecasts_leave_the_event_loop_alone(start) -> None:
    gate = Gate()
    engine = start(gate)
    gate.open.clear()
    waiting = asyncio.wrap_future(engine.submit(request()))
    turns = 0
    while turns < 20:
        await asyncio.sleep(0.001)
        turns += 1
    assert not waiting.done()
    gate.open.set()
    assert (await waiting).version.kind == "base"


def test_forecasts_are_counted_by_stage_and_deadline(start) -> None:
    telemetry = Telemetry()

    def slow(window: Tensor) -> Tensor:
        time.sleep(0.04 if window.any() else 0.0)
        return ZeroVelocity(15)(window)

    engine = start(slow, telemetry=telemetry)
    result_of(engine.submit(request()))
    text = telemetry.render().decode()
    assert "kinecast_deadline_misses_total 1.0" in text
    for stage in ("queue", "compute", "total"):
        assert f'kinecast_forecast_latency_ms_count{{stage="{stage}"}} 1.0' in text
    assert 'kinecast_forecast_latency_ms_bucket{le="33.0",stage="total"} 0.0' in text


def test_the_base_stands_in_for_no_personal_version() -> None:
    decoders = Decoders(ZeroVelocity(15), base_sha256="ab")
    for requested in ("active", "base", 0):
        assert decoders.resolve(requested).number == 0
        assert decoders.resolve(requested).requested == requested
    with pytest.raises(VersionUnavailableError):
        decoders.resolve(1)


def test_a_radius_is_given_only_where_it_is_calibrated() -> None:
    decoders = Decoders(ZeroVelocity(15), base_sha256="ab", radius=RADIUS)
    np.testing.assert_allclose(decoders.radius(0.5), RADIUS.radius(0.5))
    assert decoders.radius(0.999) is None
    assert Decoders(ZeroVelocity(15), base_sha256="ab").radius(0.5) is None


def test_a_net_of_damaged_weights_is_not_ready(start) -> None:
    class Damaged:
        def __call__(self, window: torch.Tensor) -> torch.Tensor:
            return torch.full((len(window), 15, *window.shape[2:]), float("nan"))

    assert not start(Damaged()).is_ready
