"""The stream's state machine: how connections end, and what the next one is told."""

import pytest
from kinecast_client.core import Phase
from kinecast_client.errors import (
    FINAL_CLOSES,
    FencedError,
    RefusedError,
    UserDeletedError,
)
from kinecast_client.events import Disconnected, Stopped
from kinecast_client.messages import Settings
from kinecast_client.rules import Rules

from tests.unit.clients.rig import SETTINGS, Rig


@pytest.fixture
def rig() -> Rig:
    rig = Rig()
    rig.connect()
    return rig


@pytest.mark.parametrize(("code", "kind"), [(4409, FencedError), (4410, UserDeletedError)])
def test_final_closes_stop_it_with_the_reason(rig, code, kind):
    (seq,) = rig.stream()
    rig.answer(seq)
    rig.hear("error", code="why", message="Because.", retryable=False, seq=None)
    rig.hear("bye", reason="why", retry_after_s=0.0)
    (event,) = rig.lose(code)
    assert isinstance(event, Stopped)
    assert type(event.error) is kind
    assert (event.error.close_code, event.error.code, event.error.detail) == (
        code,
        "why",
        "Because.",
    )
    assert rig.core.phase is Phase.STOPPED
    assert rig.latest is None
    assert rig.offer() is None
    assert rig.statistics.refused == {"stopped": 1}


@pytest.mark.parametrize("code", sorted(FINAL_CLOSES - {4409, 4410}))
def test_refusals_stop_it_before_the_hello_too(code):
    rig = Rig()
    rig.dial()
    rig.hear("error", code="forbidden", message="No.", retryable=False, seq=None)
    rig.hear("bye", reason="forbidden", retry_after_s=0.0)
    (event,) = rig.lose(code)
    assert isinstance(event.error, RefusedError)
    assert event.error.code == "forbidden"


def test_an_error_that_was_forgiven_is_not_the_reason_of_the_end(rig):
    rig.hear("error", code="bad_frame", message="Bad.", retryable=False, seq=3)
    rig.hear("bye", reason="user_deleted", retry_after_s=0.0)
    (event,) = rig.lose(4410)
    assert event.error.code == "user_deleted"


@pytest.mark.parametrize("code", [1000, 1001, 1006, 1009, 1011, 4408, 4429, 4499])
def test_every_other_close_is_followed_by_another_try(rig, code):
    (event,) = rig.lose(code)
    assert isinstance(event, Disconnected)
    assert event.close_code == code
    assert rig.core.phase is Phase.RESTING
    assert rig.core.retry_at == pytest.approx(rig.now + 0.1)


def test_tries_come_at_doubling_intervals_until_one_is_good(rig):
    delays = []
    for _ in range(8):
        (event,) = rig.lose()
        delays.append(event.retry_in_s)
        rig.connect()
    assert delays == pytest.approx([0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 5.0, 5.0])
    (seq,) = rig.stream()
    rig.answer(seq)
    (event,) = rig.lose()
    assert event.retry_in_s == pytest.approx(0.1)


def test_a_connection_that_lasted_was_a_good_one(rig):
    for _ in range(4):
        rig.lose()
        rig.connect()
    for _ in range(6):
        rig.wait(1.0)
        rig.hear("pong", id=0, t=0.0, server_t=0.0, engine_ms=1.0)
    (event,) = rig.lose()
    assert event.retry_in_s == pytest.approx(0.1)


@pytest.mark.parametrize("draw", [0.0, 0.5, 1.0])
def test_waits_have_jitter_and_never_exceed_five_seconds(draw):
    delays = [Rules().find_delay(failures, draw) for failures in (1, 2, 1000)]
    assert delays == pytest.approx(
        [most * (0.5 + draw / 2) for most in (0.1, 0.2, 5.0)],
    )


def test_a_service_that_says_too_fast_is_given_its_time(rig):
    rig.hear("bye", reason="too_fast", retry_after_s=7.0)
    (event,) = rig.lose(4429)
    assert event.retry_in_s == pytest.approx(7.0)


def test_a_draining_service_is_left_at_once(rig):
    rig.hear("bye", reason="draining", retry_after_s=1.0)
    (event,) = rig.lose(1001)
    assert event.retry_in_s == pytest.approx(0.1)


def test_a_new_connection_gets_settings_and_the_last_frames_again(rig):
    rig.core.configure(Settings(forecast_every=3))
    numbers = rig.stream(60)
    rig.lose()
    rig.connect()
    first, *rest = rig.drain()
    assert first == {"type": "configure", **SETTINGS, "forecast_every": 3}
    assert [frame["seq"] for frame in rest] == numbers[-19:]  # 0.6 s
    assert all(frame["replay"] for frame in rest)
    assert rest[-1]["t"] - rest[0]["t"] == pytest.approx(0.6)


def test_settings_that_the_service_has_already_are_not_sent(rig):
    assert rig.drain() == []
    rig.core.configure(Settings(coverage=0.5))
    assert [message["coverage"] for message in rig.drain()] == [0.5]


def test_settings_that_were_accepted_go_into_the_address_of_the_next_connection(rig):
    wanted = {"forecast_every": 2, "coverage": 0.5, "version": 3, "max_age_ms": 200.0}
    rig.core.configure(Settings(**wanted))
    assert rig.core.query()["version"] == "active"
    rig.hear("configured", settings=wanted, from_seq=0)
    query = rig.core.query()
    layout = query.pop("layout")
    assert query == {"session": "s", "version": 3, "coverage": 0.5, "forecast_every": 2}
    assert len(layout) == 64


@pytest.mark.parametrize("code", ["unknown_version", "bad_configure"])
def test_settings_that_were_refused_are_not_asked_for_again(rig, code):
    rig.core.configure(Settings(version=77))
    rig.drain()
    rig.hear("error", code=code, message="No.", retryable=False, seq=None)
    rig.lose()
    assert rig.core.query()["version"] == "active"
    rig.connect()
    assert rig.drain() == []


def test_a_frame_that_never_left_is_answered_by_the_next_connection(rig):
    rig.stream(3)
    rig.lose()
    rig.now += 1 / 30
    newest = rig.offer()
    rig.connect()
    *before, last = rig.drain()
    assert all(frame["replay"] for frame in before)
    assert last["seq"] == newest
    assert "replay" not in last
    rig.answer(newest)
    assert rig.latest.seq == newest


def test_a_frame_that_waited_too_long_is_not_answered(rig):
    rig.lose()
    rig.offer()
    rig.now += 0.5
    rig.connect()
    (frame,) = rig.frames()
    assert frame["replay"]


def test_frames_from_before_a_long_break_are_not_sent_again(rig):
    rig.stream(10)
    rig.lose()
    rig.now += 5.0
    rig.connect()
    assert rig.frames() == []
