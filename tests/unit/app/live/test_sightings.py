"""What a stream learns of the body in front of its sensor."""

import numpy as np
import pytest

from app.domain.users import LIVED_MAX_S, Lived
from app.live.sightings import KEPT_S, Sightings
from tests.unit.app.live.test_likeness import KNOWN
from tests.unit.app.live.test_session import PERSON, Stream, frame

BONES = np.linspace(-1.0, 0.0, 8)


def see(seconds: int, *flags: str) -> Lived | None:
    sightings = Sightings()
    for t in range(seconds):
        sightings.note(float(t), BONES, flags)
    return sightings.take()


def test_less_than_five_seconds_are_not_told() -> None:
    assert see(4) is None
    lived = see(5)
    assert lived is not None
    assert lived.seconds == 5
    np.testing.assert_allclose(lived.bones, BONES, atol=1e-4)


@pytest.mark.parametrize("flag", ["mirrored", "upside_down", "implausible_units", "frozen_input"])
def test_what_may_be_no_body_is_not_counted(flag: str) -> None:
    assert see(60, flag) is None


def test_somebody_else_is_counted_for_they_may_be_the_person() -> None:
    assert see(60, "not_this_person", "root_relative") is not None


def test_a_second_counts_once_and_what_was_taken_is_gone() -> None:
    sightings = Sightings()
    for i in range(100):
        sightings.note(i / 10, BONES, ())
    lived = sightings.take()
    assert lived is not None
    assert lived.seconds == 10
    assert sightings.take() is None


def test_a_stream_that_nobody_asks_keeps_the_last_minute() -> None:
    lived = see(500)
    assert lived is not None
    assert lived.seconds == KEPT_S


def test_a_stream_tells_the_bones_of_its_person() -> None:
    stream = Stream()
    for seq in range(240):
        stream.say(frame(seq))
    lived = stream.session.sightings.take()
    assert lived is not None
    assert 6 <= lived.seconds <= 8
    np.testing.assert_allclose(lived.bones, KNOWN, atol=0.02)


def test_a_mirrored_stream_tells_nothing() -> None:
    stream = Stream()
    for seq in range(240):
        there = frame(seq)
        joints = PERSON[seq] * np.array([-1.0, 1.0, 1.0])
        stream.say(type(there)(there.seq, there.t, joints, None, there.replay))
    assert stream.session.sightings.take() is None


def test_what_is_seen_later_weighs_by_its_seconds_and_can_always_change_it() -> None:
    ann, bob = Lived((0.0,) * 8, 30.0), Lived((1.0,) * 8, 10.0)
    assert ann.join(bob) == Lived((0.25,) * 8, 40.0)
    long = Lived((0.0,) * 8, LIVED_MAX_S)
    for _ in range(60):
        long = long.join(Lived((1.0,) * 8, 30.0))
    assert long.seconds == LIVED_MAX_S
    assert long.bones[0] > 0.9
