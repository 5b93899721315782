"""Who answers a window, how it says so, and who answers where that fails."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from app.domain.motion import VersionStamp, worst_severity
from app.live.breaker import TRIP_AFTER, Breaker
from app.live.decoders import Decoders
from app.live.guard import GuardRules
from app.live.ladder import Ladder, Landing
from app.live.telemetry import Telemetry
from app.live.work import Choice, EngineRequest
from models.baselines import DampedVelocity, Forecaster, ZeroVelocity
from models.data.synthetic import SyntheticPerson
from models.personal import PersonalDecoder
from models.spec import MotionSpec
from models.uncertainty import LEVELS, RadiusTable
from tests.versions import forecast_offline, know, make_net, make_personal

WALK = SyntheticPerson(4).record("walk", 4.0).astype(np.float64)
WAVE = SyntheticPerson(5).record("wave", 4.0).astype(np.float64)
BASE = make_net()
RADIUS = RadiusTable(np.cumsum(np.full((len(LEVELS), 15, 20), 0.01, np.float32), axis=0))


def cut(frames: np.ndarray) -> np.ndarray:
    return np.stack([frames[i : i + 15] for i in range(0, 100, 10)])


def choose(forecaster: Forecaster, number: int = 1, **fields: object) -> Choice:
    stamp = VersionStamp(number, "personal", f"{number:064}", share=1.0)
    return Choice(replace(stamp, **fields), forecaster)


def ask(choice: Choice | None, window: np.ndarray = WALK[:15]) -> EngineRequest:
    requested = "active" if choice is None else choice.stamp.requested
    return EngineRequest(window, requested, 0.9, choice)


class Clock:
    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


class House:
    """A ladder with all that belongs to it."""

    def __init__(self, base: Forecaster = BASE) -> None:
        self.clock, self.telemetry = Clock(), Telemetry()
        self.decoders = Decoders(base, base_sha256="ab", radius=RADIUS)
        self.decoders.breaker = Breaker(self.clock)
        self.ladder = Ladder(
            self.decoders, telemetry=self.telemetry, rules=GuardRules(), spec=MotionSpec()
        )

    def forecast(self, *requests: EngineRequest) -> list[Landing]:
        return self.ladder.forecast(requests)

    def count(self, metric: str) -> float:
        return self.telemetry.registry.get_sample_value(f"kinecast_{metric}_total")


class Moody:
    """A decoder of its own kind that can be broken and mended."""

    def __init__(self, failure: float | Exception = 0.0) -> None:
        self.failure, self.calls = failure, 0

    def __call__(self, window: Tensor) -> Tensor:
        self.calls += 1
        if isinstance(self.failure, Exception):
            raise self.failure
        return ZeroVelocity(15)(window) + self.failure


@pytest.fixture
def house() -> House:
    return House()


def blend(share: float, **metadata: object) -> PersonalDecoder:
    """A version that has this share in every forecast."""
    flat = {"half": 1e4 * np.log(share / (1 - share)), "width": 1e4} if 0 < share < 1 else {}
    if not flat:
        flat = {"half": 1e6 * (2 * share - 1), "width": 1.0}
    return make_personal(BASE, 1, familiarity=know(BASE, cut(WALK), **flat), **metadata)


@pytest.mark.parametrize(
    ("share", "flags"),
    [
        (0.0, ("unfamiliar",)),
        (0.2, ("unfamiliar", "blended", "uncalibrated")),
        (0.8, ("blended", "uncalibrated")),
        (1.0, ("uncalibrated",)),
    ],
)
def test_a_forecast_says_how_much_of_it_is_personal(house, share, flags) -> None:
    personal = blend(share)
    (landing,) = house.forecast(ask(choose(personal)))
    assert landing.version.share == pytest.approx(share, abs=0.01)
    assert landing.version.share == round(landing.version.share, 4)
    assert (landing.version.kind, landing.version.number) == ("personal", 1)
    assert landing.version.fallback is None
    assert landing.flags == flags
    assert worst_severity(landing.flags) == "info"
    frames = landing.displacement + WALK[14]
    np.testing.assert_allclose(frames, forecast_offline(personal, WALK[:15]), atol=1e-5)
    if share == 0:
        np.testing.assert_allclose(frames, forecast_offline(BASE, WALK[:15]), atol=1e-5)


@pytest.mark.parametrize(("share", "factor"), [(0.0, 1.0), (0.5, 1.25), (1.0, 1.5)])
def test_a_version_that_knows_its_radius_gives_it(house, share, factor) -> None:
    (landing,) = house.forecast(ask(choose(blend(share, radius_scale=1.5))))
    np.testing.assert_allclose(landing.radius, factor * RADIUS.radius(0.9), rtol=0.01)
    assert "uncalibrated" not in landing.flags


@pytest.mark.parametrize("scale", ["wide", None, True, 0, -1.0, float("nan"), float("inf")])
def test_a_radius_that_makes_no_sense_is_none(house, scale) -> None:
    (landing,) = house.forecast(ask(choose(blend(1.0, radius_scale=scale))))
    assert landing.radius is None
    assert "uncalibrated" in landing.flags


def test_the_base_says_nothing_of_familiarity(house) -> None:
    (landing,) = house.forecast(ask(None))
    assert (landing.version.share, landing.version.kind, landing.flags) == (0.0, "base", ())
    np.testing.assert_allclose(landing.radius, RADIUS.radius(0.9))


@pytest.mark.parametrize("seed", range(4))
def test_alone_and_among_other_versions_a_window_gets_the_same(house, seed) -> None:
    windows = np.concatenate([cut(WALK), cut(WAVE)])
    walker = make_personal(BASE, 1, familiarity=know(BASE, cut(WALK), half=0.6, width=0.15))
    pinned = choose(make_personal(BASE, 2), 7, requested=7)
    choices = [None, choose(walker), pinned, choose(ZeroVelocity(15), 3)]
    draw = np.random.default_rng(seed)
    requests = [
        ask(choices[i], window) for i, window in zip(draw.integers(0, 4, 20), windows, strict=True)
    ]
    together = house.forecast(*requests)
    assert {one.version.number for one in together} == {0, 1, 3, 7}
    for request, landing in zip(requests, together, strict=True):
        (alone,) = house.forecast(request)
        np.testing.assert_allclose(landing.displacement, alone.displacement, atol=1e-5)
        assert landing.version.share == pytest.approx(alone.version.share, abs=2e-4)
        assert replace(landing.version, share=0.0) == replace(alone.version, share=0.0)
        assert (landing.radius is None) == (alone.radius is None)


@pytest.mark.parametrize(
    ("failure", "reason"),
    [(RuntimeError("no"), "engine_error"), (float("nan"), "guard"), (9.0, "guard")],
)
def test_rungs_are_taken_one_after_the_other(house, failure, reason) -> None:
    active, previous = Moody(failure), Moody()
    second = choose(previous, 1, fallback="previous_version")
    choice = replace(choose(active, 2), previous=second)
    (landing,) = house.forecast(ask(choice))
    assert landing.version == second.stamp
    assert "fallback" in landing.flags
    previous.failure = failure
    (landing,) = house.forecast(ask(choice))
    assert (landing.version.kind, landing.version.fallback) == ("base", reason)
    assert landing.version.share == 0.0
    np.testing.assert_allclose(landing.radius, RADIUS.radius(0.9))
    np.testing.assert_allclose(
        landing.displacement + WALK[14], forecast_offline(BASE, WALK[:15]), atol=1e-5
    )
    active.failure = 0.0
    assert house.forecast(ask(choice))[0].version == choice.stamp


def test_below_the_base_the_person_slows_down_or_stands(house) -> None:
    broken = House(Moody(RuntimeError("no")))
    choice = choose(Moody(float("nan")))
    (landing,) = broken.forecast(ask(choice))
    assert (landing.version.kind, landing.version.fallback) == ("damped_velocity", "guard")
    expected = DampedVelocity(15)(torch.from_numpy(WALK[None, :15])).numpy()[0] - WALK[14]
    np.testing.assert_allclose(landing.displacement, expected, atol=1e-6)
    leap = WALK[:15].copy()
    leap[-1] += 5.0
    (landing,) = broken.forecast(ask(choice, leap))
    assert landing.version.kind == "zero_velocity"
    assert not landing.displacement.any()


def test_nothing_answers_in_the_place_of_a_pinned_version(house) -> None:
    (landing,) = house.forecast(ask(choose(Moody(float("nan")), 4, requested=4)))
    assert landing.version.replaces_pinned


def test_one_that_keeps_failing_is_passed_over_and_tried_again(house) -> None:
    moody = Moody(RuntimeError("no"))
    request = ask(choose(moody))
    for _ in range(TRIP_AFTER + 3):
        (landing,) = house.forecast(request)
        assert (landing.version.kind, landing.version.fallback) == ("base", "engine_error")
        assert "fallback" in landing.flags
    assert moody.calls == TRIP_AFTER
    assert house.count("decoder_trips") == 1
    moody.failure = 0.0
    house.clock.now += 9.9
    assert house.forecast(request)[0].version.kind == "base"
    house.clock.now += 0.2
    assert house.forecast(request)[0].version == request.choice.stamp
    assert house.count("decoder_trips") == 1


def test_nobody_else_notices_a_decoder_that_fails(house) -> None:
    sick = make_personal(BASE, 3)
    sick.decoder.register_forward_pre_hook(lambda *_: (_ for _ in ()).throw(RuntimeError("no")))
    healthy = make_personal(BASE, 4)
    requests = [ask(choose(sick, 1)), ask(choose(healthy, 2)), ask(None)]
    for _ in range(TRIP_AFTER + 1):
        failed, fine, base = house.forecast(*requests)
        assert (failed.version.kind, failed.version.fallback) == ("base", "engine_error")
        assert (fine.version.number, fine.version.fallback) == (2, None)
        assert (base.version.number, base.version.fallback) == (0, None)


def test_an_odd_window_of_the_base_blames_no_version(house) -> None:
    wild = House(Moody(float("nan")))
    for _ in range(TRIP_AFTER + 1):
        (landing,) = wild.forecast(ask(None))
        assert (landing.version.kind, landing.version.fallback) == ("damped_velocity", "guard")
    assert wild.count("decoder_trips") == 0


def test_what_the_base_did_alone_does_not_count_against_a_version() -> None:
    base = make_net()
    base.decoder.predict.bias.data += 1e4
    stranger = make_personal(base, 1, familiarity=know(base, cut(WALK), half=-1e6, width=1.0))
    wild = House(base)
    for _ in range(TRIP_AFTER + 1):
        (landing,) = wild.forecast(ask(choose(stranger)))
        assert (landing.version.kind, landing.version.fallback) == ("damped_velocity", "guard")
    assert wild.count("decoder_trips") == 0
