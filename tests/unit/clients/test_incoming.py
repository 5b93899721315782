"""Which forecasts are handed out: none that is old, foreign or broken."""

import math

import numpy as np
import pytest
from kinecast_client.rules import Rules

from tests.unit.clients.rig import Rig


@pytest.fixture(params=["json", "msgpack"])
def rig(request) -> Rig:
    rig = Rig(request.param)
    rig.connect()
    return rig


def test_there_is_none_before_the_first(rig):
    assert rig.latest is None


def test_a_forecast_is_none_any_more_150_ms_after_it_came(rig):
    (seq,) = rig.stream()
    rig.answer(seq)
    rig.now += 0.149
    assert rig.latest.seq == seq
    rig.now += 0.002
    assert rig.latest is None


def test_a_forecast_that_comes_late_is_counted_and_not_used(rig):
    (seq,) = rig.stream()
    t = rig.now
    rig.now += 0.201
    rig.answer(seq, t)
    assert rig.latest is None
    assert (rig.statistics.late, rig.statistics.forecasts) == (1, 0)


def test_a_forecast_grows_too_old_in_our_hands():
    rig = Rig(rules=Rules(hold_s=10.0))
    rig.connect()
    (seq,) = rig.stream()
    t = rig.now
    rig.now += 0.1
    rig.answer(seq, t)
    assert rig.latest.age_s == pytest.approx(0.1)
    rig.now += 0.099
    assert rig.latest is not None
    rig.now += 0.002
    assert rig.latest is None


def test_a_clock_of_the_frames_that_is_ahead_makes_nothing_look_fresh(rig):
    (seq,) = rig.stream()
    ahead = rig.now + 3600.0
    rig.now += 1 / 30
    seq = rig.offer(t=ahead)
    rig.drain()
    rig.now += 0.19
    rig.answer(seq, ahead)
    assert rig.latest.age_s == pytest.approx(0.19)
    rig.now += 0.011
    assert rig.latest is None


def test_a_clock_of_the_frames_that_is_behind_gives_nothing(rig):
    seq = rig.offer(t=rig.now - 3600.0)
    rig.drain()
    rig.answer(seq, rig.now - 3600.0)
    assert rig.latest is None
    assert rig.statistics.late == 1


def test_another_clock_of_the_frames_does_where_it_is_the_streams(rig):
    rig.skew = -3600.0
    (seq,) = rig.stream()
    rig.answer(seq)
    assert rig.latest.age_s == pytest.approx(0.0)


def test_only_newer_forecasts_are_taken(rig):
    first, second = rig.stream(2)
    rig.answer(second)
    rig.answer(first, rig.now - 1 / 30)
    rig.answer(second)
    assert rig.latest.seq == second
    assert (rig.statistics.forecasts, rig.statistics.late) == (1, 2)


@pytest.mark.parametrize("seq", [None, -1, 7, 2**60])
def test_a_forecast_of_a_frame_that_was_never_sent_is_not_taken(rig, seq):
    rig.stream()
    rig.answer(seq)
    assert rig.latest is None
    assert rig.statistics.mismatched + rig.statistics.malformed == 1


def test_a_forecast_of_a_frame_that_waits_to_be_sent_is_not_taken(rig):
    seq = rig.offer()
    rig.answer(seq)
    assert rig.latest is None


def test_a_forecast_for_another_time_is_not_taken(rig):
    (seq,) = rig.stream()
    rig.answer(seq, rig.now + 0.01)
    rig.hear("forecast", **(rig.forecast(seq, rig.now) | {"t": rig.now + 0.01}))
    assert rig.latest is None
    assert rig.statistics.mismatched == 2


def as_sent(rig: Rig, array: np.ndarray) -> object:
    return array.tobytes() if rig.form == "msgpack" else array.tolist()


def test_arrays_of_another_size_are_not_taken(rig):
    (seq,) = rig.stream()
    for name, shape, dtype in (
        ("frames", (15, 3, 3), "<f4"),
        ("frames", (14, 2, 3), "<f4"),
        ("radius", (15, 3), "<f4"),
        ("t_out", (14,), "<f8"),
    ):
        rig.answer(seq, **{name: as_sent(rig, np.ones(shape, dtype))})
    assert rig.latest is None
    assert rig.statistics.mismatched == 4


def test_times_that_are_not_those_of_the_horizon_are_not_taken(rig):
    (seq,) = rig.stream()
    rig.answer(seq, t_out=as_sent(rig, rig.now + np.arange(1, 16) / 25))
    assert rig.latest is None
    assert rig.statistics.mismatched == 1


def test_numbers_that_are_none_are_not_taken():
    rig = Rig("msgpack")
    rig.connect()
    (seq,) = rig.stream()
    frames = np.ones((15, 2, 3), "<f4")
    frames[3, 1, 2] = math.nan
    rig.answer(seq, frames=frames.tobytes())
    rig.answer(seq, radius=np.full((15, 2), -1.0, "<f4").tobytes())
    rig.answer(seq, t_out=np.full(15, math.nan, "<f8").tobytes())
    assert rig.latest is None
    assert (rig.statistics.malformed, rig.statistics.mismatched) == (2, 1)


@pytest.mark.parametrize("value", [None, 3, "frames", [[1, 2], [3]], {"a": 1}, True])
def test_arrays_that_are_none_are_not_taken(rig, value):
    (seq,) = rig.stream()
    rig.answer(seq, frames=value)
    assert rig.latest is None
    assert rig.statistics.malformed + rig.statistics.mismatched == 1


def test_a_radius_may_be_absent(rig):
    (seq,) = rig.stream()
    rig.answer(seq, radius=None)
    assert rig.latest.radius is None


def test_frames_that_were_sent_again_are_answered_by_nobody(rig):
    numbers = rig.stream(5)
    t = rig.now
    rig.lose()
    rig.connect()
    rig.drain()
    rig.answer(numbers[-1], t)
    assert rig.latest is None
    assert rig.statistics.mismatched == 1


def test_a_reconnect_hands_out_new_forecasts_only(rig):
    (seq,) = rig.stream()
    rig.answer(seq)
    rig.lose()
    assert rig.latest.seq == seq  # still fresh: the robot goes on with it
    rig.connect()
    assert rig.latest is None
    (seq,) = rig.stream()
    rig.answer(seq)
    assert rig.latest.seq == seq


def test_a_reset_forgets_what_was_observed_and_what_is_on_its_way(rig):
    first, second = rig.stream(2)
    rig.answer(first, rig.now - 1 / 30)
    rig.core.outgoing.reset()
    assert rig.latest is None
    rig.answer(second)
    assert rig.latest is None
    assert [message["type"] for message in rig.drain()] == ["reset"]
    rig.lose()
    rig.connect()
    assert rig.frames() == []
    (seq,) = rig.stream()
    rig.answer(seq)
    assert rig.latest.seq == seq


def test_a_clock_that_was_restarted_begins_anew(rig):
    first, second = rig.stream(2)
    rig.answer(first, rig.now - 1 / 30)
    rig.skew = -500.0
    rig.now += 1 / 30
    third = rig.offer()
    assert third == second + 1
    assert rig.latest is None
    rig.drain()
    rig.answer(second, rig.now - 1 / 30)
    assert rig.latest is None
    rig.answer(third)
    assert rig.latest.seq == third


def test_latencies_are_summed_up(rig):
    for delay in (0.01, 0.02, 0.03):
        (seq,) = rig.stream()
        t = rig.now
        rig.now += delay
        rig.answer(seq, t)
    statistics = rig.statistics
    assert statistics.age.p50 == pytest.approx(20.0)
    assert statistics.response.worst == pytest.approx(30.0)
    assert statistics.service.p50 == pytest.approx(0.6)
    assert statistics.age.p50 <= statistics.age.p90 <= statistics.age.p99 <= statistics.age.worst
    assert statistics.age.count == 3
    assert math.isnan(statistics.round_trip.p50)
    assert (statistics.offered, statistics.sent, statistics.reconnects) == (3, 3, 0)
