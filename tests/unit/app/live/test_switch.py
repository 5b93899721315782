"""Whose weights answer a window: in the engine, and on a stream while they change."""

import threading

import numpy as np
import pytest
import torch
from torch import Tensor

from app.domain.motion import VersionStamp
from app.live.actions import Action, Send, Submit
from app.live.decoders import Decoders
from app.live.engine import Engine
from app.live.protocol import Configure, Configured, ErrorMessage, Forecast, VersionMessage
from app.live.work import Choice, EngineRequest, EngineResult
from models.baselines import DampedVelocity, Forecaster, ZeroVelocity
from tests.unit.app.live.test_session import PERSON, Stream, frame, result, sent

MINE = Choice(VersionStamp(1, "personal", "cd", share=1.0), ZeroVelocity(15), "promoted")


def submit(actions: list[Action]) -> Submit:
    (action,) = actions
    assert isinstance(action, Submit)
    return action


@pytest.fixture
def stream() -> Stream:
    stream = Stream()
    stream.show(range(20))
    return stream


def test_a_forecast_on_its_way_is_made_anew_after_the_change(stream) -> None:
    on_its_way = stream.submit(20)
    (told,) = sent(stream.session.switch(MINE))
    assert told == VersionMessage(MINE.stamp, "promoted")
    again = submit(stream.session.answer(on_its_way.ticket, result(), stream.now))
    assert (again.ticket.seq, again.request.choice) == (20, MINE)
    (forecast,) = sent(stream.session.answer(again.ticket, result(MINE.stamp), stream.now))
    assert isinstance(forecast, Forecast)
    assert (forecast.seq, forecast.skipped) == (20, 0)
    assert "version_changed" in forecast.quality


def test_where_a_newer_frame_waits_already_the_old_one_is_counted(stream) -> None:
    old = stream.submit(20)
    stream.session.switch(MINE)
    newer = submit(stream.say(frame(21)))
    assert stream.session.answer(old.ticket, result(), stream.now) == []
    (forecast,) = sent(stream.session.answer(newer.ticket, result(MINE.stamp), stream.now))
    assert (forecast.seq, forecast.skipped) == (21, 1)


def test_the_same_version_again_is_no_change(stream) -> None:
    stream.session.switch(MINE)
    assert stream.session.switch(Choice(MINE.stamp, DampedVelocity(15), "by_hand")) == []


def test_a_stream_that_asked_for_the_base_keeps_it(stream) -> None:
    stream.say(Configure(version="base"))
    assert stream.session.switch(MINE) == []
    assert stream.submit(20).request.choice.stamp.kind == "base"
    stream.say(Configure(version="active"))
    assert submit(stream.say(frame(21))).request.choice == MINE


def test_a_pinned_version_is_never_replaced(stream) -> None:
    pinned = Choice(VersionStamp(1, "personal", "cd", requested=1, share=1.0), ZeroVelocity(15))
    stream.session.weights.pin(pinned)
    assert isinstance(sent(stream.say(Configure(version=1)))[0], Configured)
    asked = stream.submit(20)
    assert asked.request.choice == pinned
    base = VersionStamp(0, "base", "ab", requested=1, fallback="engine_error")
    (error,) = sent(stream.session.answer(asked.ticket, result(base), stream.now))
    assert isinstance(error, ErrorMessage)
    assert (error.code, error.seq) == ("version_unavailable", 20)
    (refused,) = stream.say(Configure(version=2))
    assert isinstance(refused, Send)
    assert refused.message.code == "unknown_version"


class Broken:
    """A net that fails, for ever or for one window."""

    def __call__(self, window: Tensor) -> Tensor:
        raise RuntimeError("out of order")


def forecast_all(engine: Engine, choices: list[Choice | None]) -> list[EngineResult]:
    """Have all of these in one batch."""
    done: list[EngineResult | None] = [None] * len(choices)
    left = threading.Semaphore(0)
    with engine._condition:  # so that the engine finds all of them at once
        for i, choice in enumerate(choices):

            def keep(result: EngineResult, i: int = i) -> None:
                done[i] = result
                left.release()

            request = EngineRequest(PERSON[i : i + 15], "active", 0.9, choice)
            engine.open_slot().put(request, keep)
    for _ in choices:
        assert left.acquire(timeout=10)
    return [one for one in done if one is not None]


@pytest.fixture
def engine():
    engine = Engine(Decoders(DampedVelocity(15), base_sha256="ab"), batch=8)
    engine.start()
    assert engine.wait_ready(10.0)
    yield engine
    engine.stop()


def offline(forecaster: Forecaster, i: int) -> np.ndarray:
    window = torch.from_numpy(PERSON[i : i + 15])[None]
    return (forecaster(window).double() - window[:, -1:])[0].numpy()


def test_a_batch_is_sorted_by_whose_weights_answer(engine) -> None:
    other = Choice(VersionStamp(2, "personal", "ef", share=1.0), DampedVelocity(15, decay=0.5))
    choices = [None, MINE, None, other, MINE, other]
    results = forecast_all(engine, choices)
    for i, (choice, made) in enumerate(zip(choices, results, strict=True)):
        forecaster = DampedVelocity(15) if choice is None else choice.forecaster
        np.testing.assert_allclose(made.displacement, offline(forecaster, i), atol=1e-5)
        assert made.version.sha256 == ("ab" if choice is None else choice.stamp.sha256)
        assert made.radius is None
        assert made.flags == ("uncalibrated",)


def test_a_broken_decoder_gives_way_to_the_base_and_harms_nobody(engine) -> None:
    broken = Choice(VersionStamp(3, "personal", "00", share=1.0), Broken())
    hurt, fine = forecast_all(engine, [broken, MINE])
    assert (hurt.version.kind, hurt.version.number) == ("base", 0)
    assert (hurt.version.fallback, hurt.version.share) == ("engine_error", 0.0)
    assert "fallback" in hurt.flags
    np.testing.assert_allclose(hurt.displacement, offline(DampedVelocity(15), 0), atol=1e-5)
    assert fine.version == MINE.stamp


def test_where_the_base_fails_as_well_the_person_slows_down() -> None:
    engine = Engine(Decoders(Broken(), base_sha256="ab"), batch=8)
    engine.start()
    engine.wait_ready(10.0)
    try:
        broken = Choice(VersionStamp(3, "personal", "00", share=1.0), Broken())
        (made,) = forecast_all(engine, [broken])
    finally:
        engine.stop()
    assert (made.version.kind, made.version.number) == ("damped_velocity", None)
    assert made.version.fallback == "engine_error"
