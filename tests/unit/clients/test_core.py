"""The stream's state machine: connections, silence, and what is sent."""

import math

import numpy as np
import pytest
from kinecast_client.core import Phase
from kinecast_client.errors import (
    FrameError,
)
from kinecast_client.events import Connected

from tests.unit.clients.rig import JOINTS, POSE, SETTINGS, Rig


@pytest.fixture
def rig() -> Rig:
    rig = Rig()
    rig.connect()
    return rig


def test_a_hello_opens_the_stream():
    rig = Rig()
    assert rig.core.outgoing.joint_count is None
    (event,) = rig.connect()
    assert isinstance(event, Connected)
    assert rig.core.phase is Phase.OPEN
    assert rig.core.outgoing.joint_count == len(JOINTS)


def test_frames_leave_in_order_with_rising_numbers(rig):
    assert [rig.stream()[0] for _ in range(3)] == [0, 1, 2]
    rig.now += 1 / 30
    rig.offer()
    (frame,) = rig.frames()
    assert (frame["seq"], frame["t"]) == (3, rig.now)
    assert frame["joints"] == POSE.tolist()
    assert "replay" not in frame


def test_nothing_is_sent_before_the_hello():
    rig = Rig()
    rig.dial()
    rig.offer()
    assert rig.drain() == []


def test_a_missing_joint_and_a_missing_person_are_null(rig):
    rig.offer(joints=np.array([[math.nan, 1.0, 1.0], [1.0, 2.0, 3.0]]))
    rig.now += 1 / 30
    rig.offer(joints=None)
    first, second = rig.frames()
    assert first["joints"] == [None, [1.0, 2.0, 3.0]]
    assert second["joints"] is None


def test_the_caller_may_use_its_array_again_at_once(rig):
    pose = POSE.copy()
    rig.offer(joints=pose)
    pose[:] = 99.0
    assert rig.frames()[0]["joints"] == POSE.tolist()


@pytest.mark.parametrize("joints", [np.zeros((3, 3)), np.zeros((2, 2)), "pose", [[1, 2, 3], [4]]])
def test_what_is_no_frame_of_this_skeleton_raises(rig, joints):
    with pytest.raises(FrameError):
        rig.offer(joints=joints)


def test_a_time_or_a_confidence_that_is_none_raises(rig):
    with pytest.raises(FrameError):
        rig.offer(t="noon")
    with pytest.raises(FrameError):
        rig.core.offer(POSE, None, [1.0], rig.moment())


@pytest.mark.parametrize(
    ("t", "joints", "reason"),
    [
        (math.nan, POSE, "bad_time"),
        (math.inf, POSE, "bad_time"),
        (0.0, POSE, "t_not_increasing"),
        (-0.9, POSE, "t_not_increasing"),
        (0.001, POSE, "too_fast"),
        (0.05, np.full((2, 3), math.inf), "bad_frame"),
        (0.05, POSE * 1000.0, "bad_frame"),
    ],
)
def test_what_the_service_would_refuse_is_counted_and_not_sent(rig, t, joints, reason):
    assert rig.offer(t=50.0) == 0
    rig.drain()
    assert rig.offer(t=50.0 + t, joints=joints) is None
    assert rig.statistics.refused == {reason: 1}
    assert rig.drain() == []


def test_frames_of_another_skeleton_that_came_before_the_hello_are_dropped():
    rig = Rig()
    rig.offer(joints=np.zeros((20, 3)))
    rig.connect()
    assert rig.frames() == []
    assert rig.statistics.refused == {"wrong_joint_count": 1}


def test_a_forecast_is_handed_out_with_everything_it_says(rig):
    (seq,) = rig.stream()
    rig.answer(seq, severity="degraded", quality=["gap"], filled=["head"], skipped=2, not_due=1)
    forecast = rig.latest
    assert forecast.frames.shape == (15, 2, 3)
    assert forecast.frames.dtype == np.float32
    assert forecast.t == pytest.approx(rig.now + np.arange(1, 16) / 30)
    assert forecast.radius.shape == (15, 2)
    assert (forecast.seq, forecast.t_observed, forecast.joints) == (seq, rig.now, JOINTS)
    assert (forecast.severity, forecast.quality, forecast.filled) == (
        "degraded",
        ("gap",),
        ("head",),
    )
    assert (forecast.version.kind, forecast.coverage) == ("base", 0.9)
    assert forecast.is_usable
    assert forecast.joint("left_hand") == 1
    with pytest.raises(KeyError, match="tail"):
        forecast.joint("tail")
    rig.now += 0.1
    assert forecast.age_s == pytest.approx(0.1)
    assert (rig.statistics.skipped, rig.statistics.not_due) == (2, 1)


def test_a_severity_that_is_not_known_is_unsafe(rig):
    (seq,) = rig.stream()
    rig.answer(seq, severity="catastrophic")
    assert rig.latest.severity == "unsafe"
    assert not rig.latest.is_usable


def test_the_newest_frames_win_where_nothing_can_be_sent(rig):
    for _ in range(90):  # three seconds of a link that takes nothing
        rig.now += 1 / 30
        newest = rig.offer()
    waiting = rig.frames()
    assert [frame["seq"] for frame in waiting] == list(range(newest - 18, newest + 1))
    assert rig.statistics.unsent == 90 - 19


def test_no_more_is_sent_than_the_service_reads(rig):
    rig.lose()
    rig.connect(limits={"max_rate_hz": 20.0})
    sent = 0
    for _ in range(100):
        rig.now += 1 / 18.1
        rig.offer()
        sent += len(rig.drain())
    assert sent <= 20 + 1.05 * 20 * 100 / 18.1


def test_the_full_rate_of_the_service_is_kept_up_for_minutes(rig):
    late = []
    for step in range(120 * 120):
        rig.now += 1 / 120
        rig.core.tick(rig.moment())
        newest = rig.offer()
        sent = rig.drain()
        rig.hear("waiting", seq=newest, t=rig.now, reason="warm_up", have_s=0.0, need_s=0.45)
        if step % 60 == 0:
            rig.hear("ping", id=1, server_t=rig.now)
        numbers = [message["seq"] for message in sent if message["type"] == "frame"]
        late.append(newest - numbers[-1] if numbers else 99)
    assert max(late) == 0


def test_pings_of_the_service_are_answered_with_the_clock_of_the_frames(rig):
    rig.skew = 77.0
    rig.hear("ping", id=4, server_t=9.0)
    assert rig.drain() == [{"type": "pong", "id": 4, "server_t": 9.0, "t": rig.now + 77.0}]


def test_a_ping_that_took_long_is_not_answered(rig):
    """Its pong would mislead the service by half of that."""
    rig.wait(0.05)
    (ping,) = rig.drain()
    rig.hear("pong", id=ping["id"], t=ping["t"], server_t=rig.now + 500.0, engine_ms=1.0)
    rig.hear("ping", id=1, server_t=rig.now + 500.0 - 0.2)
    assert rig.drain() == []
    rig.hear("ping", id=2, server_t=rig.now + 500.0 - 0.02)
    assert [message["type"] for message in rig.drain()] == ["pong"]


def test_a_clock_that_was_restarted_is_compared_anew(rig):
    rig.wait(0.05)
    (ping,) = rig.drain()
    rig.hear("pong", id=ping["id"], t=ping["t"], server_t=rig.now + 500.0, engine_ms=1.0)
    rig.stream()
    assert rig.core.clock.offset_s == pytest.approx(500.0, abs=0.1)
    rig.hear("waiting", seq=0, t=rig.now, reason="warm_up", have_s=0.0, need_s=0.45)
    rig.now += 6.0
    rig.core.tick(rig.moment())
    (ping,) = [message for message in rig.drain() if message["type"] == "ping"]
    rig.skew = -100.0
    rig.stream()
    rig.hear("pong", id=ping["id"], t=ping["t"], server_t=rig.now + 500.0, engine_ms=1.0)
    assert rig.core.clock.offset_s is None  # the ping was of the clock before
    rig.hear("ping", id=1, server_t=rig.now + 500.0)
    assert [message["type"] for message in rig.drain()] == ["pong"]


def test_a_clock_that_is_set_back_by_less_than_a_restart_begins_anew(rig):
    rig.stream(20)
    first = rig.core.outgoing.floor
    rig.skew = -0.5
    (seq,) = rig.stream()
    assert seq is not None
    assert rig.core.outgoing.floor == seq > first
    assert rig.core.hang_up == "the clock of the frames was set back"
    rig.lose()
    rig.connect()
    rig.stream(3)
    assert rig.core.hang_up is None
    assert rig.statistics.refused == {}


def test_without_a_number_from_the_clock_nothing_is_fresh(rig):
    (seq,) = rig.stream()
    rig.answer(seq)
    held = rig.latest
    assert held is not None
    rig.skew = math.nan
    assert rig.latest is None
    assert held.age_s == math.inf


def test_the_offset_of_the_clocks_is_that_of_the_quickest_pong(rig):
    for delay, error in ((0.2, 0.05), (0.002, 0.0), (0.3, 0.1)):
        while not (sent := rig.drain()):
            rig.wait(0.05)
        (ping,) = sent
        rig.now += delay
        rig.hear(
            "pong", id=ping["id"], t=ping["t"], server_t=rig.now - delay / 2 + 500 + error,
            engine_ms=1.0,
        )  # fmt: skip
    assert rig.core.clock.offset_s == pytest.approx(500.0)
    assert rig.core.clock.rtt_s == pytest.approx(0.002)
    assert rig.statistics.round_trip.count == 3


def test_a_pong_that_was_not_asked_for_teaches_nothing(rig):
    rig.hear("pong", id=99, t=rig.now, server_t=1.0, engine_ms=1.0)
    assert rig.core.clock.offset_s is None


def test_a_service_that_answers_nothing_is_given_up_after_two_seconds(rig):
    rig.stream()
    rig.wait(1.9)
    assert rig.core.hang_up is None
    rig.wait(0.3)
    assert "said nothing" in rig.core.hang_up
    assert rig.drain() == []


def test_silence_is_asked_about_before_it_counts(rig):
    rig.wait(0.1)
    rig.drain()  # the first ping
    rig.hear("pong", id=1, t=rig.now, server_t=1.0, engine_ms=1.0)
    for _ in range(10):  # forecast_every: frames may go unanswered for long
        rig.stream()
        rig.wait(1.2)
        pings = [message for message in rig.drain() if message["type"] == "ping"]
        assert pings
        rig.hear("pong", id=pings[-1]["id"], t=rig.now, server_t=1.0, engine_ms=1.0)
    assert rig.core.hang_up is None


def test_garbage_is_no_sign_of_life(rig):
    rig.stream()
    for _ in range(25):
        rig.wait(0.1)
        rig.receive("{")
    assert rig.core.hang_up is not None
    assert rig.statistics.malformed > 15


def test_a_service_without_a_hello_is_given_up(rig):
    rig.lose()
    rig.dial()
    rig.wait(5.2)
    assert rig.core.hang_up == "no hello in time"


@pytest.mark.parametrize(
    "changes",
    [
        {"user": "bob"},
        {"session": "another"},
        {"epoch": 1},
        {"epoch": 0},
        {"joints": [], "epoch": 2},
        {"horizon": 0},
        {"horizon": 2**40},
        {"rate_hz": 0.0},
    ],
)
def test_a_hello_that_cannot_be_ours_is_hung_up_on(changes):
    rig = Rig()
    if "epoch" in changes and "joints" not in changes:
        rig.connect()
        rig.lose()
    assert rig.connect(**changes) == []
    assert rig.core.hang_up is not None
    assert rig.drain() == []
    (event,) = rig.lose()
    assert event.reason == rig.core.last_failure


def test_another_skeleton_or_protocol_stops_it(rig):
    rig.lose()
    (event,) = rig.connect(joints=["one", "two", "three"])
    assert event.error.code == "layout_mismatch"
    other = Rig()
    (event,) = other.connect(protocol=2)
    assert event.error.code == "unsupported_protocol"


def test_a_skeleton_that_was_expected_is_checked_at_the_first_hello():
    rig = Rig(joints=("a", "b"))
    assert rig.core.query()["layout"]
    (event,) = rig.connect()
    assert event.error.code == "layout_mismatch"


def test_anything_before_the_hello_or_a_second_one_is_hung_up_on(rig):
    rig.greet()
    assert rig.core.hang_up == "a second hello"
    other = Rig()
    other.dial()
    other.hear("waiting", seq=0, t=0.0, reason="gap", have_s=0.0, need_s=0.45)
    assert other.core.hang_up is not None


def test_what_old_connections_say_is_ignored(rig):
    old = rig.core.connection
    (seq,) = rig.stream()
    rig.lose()
    rig.connect()
    rig.hear("forecast", connection=old, **rig.forecast(seq, rig.now))
    assert rig.core.lost(old, 4409, "", rig.moment()) == []
    assert rig.latest is None
    assert rig.core.phase is Phase.OPEN


def test_unknown_messages_and_fields_are_ignored(rig):
    assert rig.hear("aurora", colour="green") == []
    (seq,) = rig.stream()
    rig.answer(seq, novelty=[1, 2, 3])
    assert rig.latest.seq == seq
    assert rig.statistics.malformed == 0


def test_news_of_the_service_reach_the_caller(rig):
    (waiting,) = rig.hear("waiting", seq=0, t=0.0, reason="person_lost", have_s=0.1, need_s=0.45)
    assert (waiting.reason, rig.core.waiting) == ("person_lost", "person_lost")
    (seq,) = rig.stream()
    rig.answer(seq)
    assert rig.core.waiting is None
    personal = {"number": 3, "kind": "personal", "sha256": "9b"}
    (changed,) = rig.hear("version", version=personal, reason="promoted")
    assert (changed.reason, rig.core.version.number) == ("promoted", 3)
    (error,) = rig.hear("error", code="gap", message="m", retryable=False, seq=4)
    assert rig.core.last_error is error
    (job,) = rig.hear("job", id="j", state="running", progress={"phase": "training"})
    assert job.progress == {"phase": "training"}
    (configured,) = rig.hear("configured", settings=SETTINGS, from_seq=3)
    assert configured.from_seq == 3


def test_codes_of_errors_cannot_fill_the_memory(rig):
    for number in range(1000):
        rig.hear("error", code=f"code_{number}", message="m", retryable=False, seq=None)
    assert len(rig.statistics.errors) <= 65
    assert sum(rig.statistics.errors.values()) == 1000


def test_a_closed_stream_does_nothing_any_more(rig):
    (seq,) = rig.stream()
    rig.answer(seq)
    rig.core.close()
    assert rig.latest is None
    assert rig.offer() is None
    assert rig.drain() == []
    assert rig.lose() == []
    rig.dial()  # another thread was about to
    assert rig.core.phase is Phase.CLOSED
    assert rig.greet() == []
