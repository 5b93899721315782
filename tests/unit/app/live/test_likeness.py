"""Who is in front of the sensor: the person whose weights are used, or somebody else."""

import numpy as np
import pytest

from app.domain.body import GuardRules, is_stranger, measure_bones
from app.domain.motion import VersionStamp
from app.live.actions import Submit
from app.live.guard import Likeness
from app.live.protocol import Configure, Forecast
from app.live.work import Choice
from models.baselines import ZeroVelocity
from models.data.clips import load_clips
from models.data.synthetic import SyntheticPerson
from tests.unit.app.live.test_session import PERSON, Stream, frame

RULES = GuardRules()
KNOWN = measure_bones(PERSON[:60])
STAMP = VersionStamp(1, "personal", "cd", share=1.0)


def choose(bones: np.ndarray | None) -> Choice:
    return Choice(STAMP, ZeroVelocity(15), bones=None if bones is None else tuple(bones.tolist()))


def watch(bones: np.ndarray | None, frames: int = 60) -> list[Submit]:
    """What a stream asks the engine for, of a person whose version knows these bones."""
    stream = Stream()
    stream.session.switch(choose(bones))
    actions = [action for seq in range(frames) for action in stream.say(frame(seq))]
    return [action for action in actions if isinstance(action, Submit)]


def test_ones_own_version_answers() -> None:
    for bones in (KNOWN, None):
        asked = watch(bones)
        assert {action.request.choice.stamp for action in asked} == {STAMP}
        assert not any("not_this_person" in action.ticket.ready.flags for action in asked)


def test_the_base_answers_somebody_else_after_a_second() -> None:
    asked = watch(KNOWN + 0.3)
    strange = ["not_this_person" in action.ticket.ready.flags for action in asked]
    first = next(action.ticket.seq for action, odd in zip(asked, strange, strict=True) if odd)
    assert 30 <= first <= 31
    assert all(strange[strange.index(True) :])
    for action, odd in zip(asked, strange, strict=True):
        stamp = action.request.choice.stamp
        expected = ("base", 0.0, "guard") if odd else ("personal", 1.0, None)
        assert (stamp.kind, stamp.share, stamp.fallback) == expected


def test_a_pinned_version_is_flagged_and_not_replaced() -> None:
    stream = Stream()
    pinned = VersionStamp(3, "personal", "ef", requested=3, share=1.0)
    bones = tuple((KNOWN + 0.3).tolist())
    stream.session.weights.pin(Choice(pinned, ZeroVelocity(15), bones=bones))
    stream.say(Configure(version=3))
    asked = [a for seq in range(40) for a in stream.say(frame(seq)) if isinstance(a, Submit)]
    assert "not_this_person" in asked[-1].ticket.ready.flags
    assert asked[-1].request.choice.stamp == pinned
    (answer,) = stream.answer(asked[-1])
    assert isinstance(answer, Forecast)
    assert answer.severity == "degraded"


def test_a_new_scene_is_given_a_second_again() -> None:
    stream = Stream()
    stream.session.switch(choose(KNOWN + 0.3))
    late = [a for seq in range(40) for a in stream.say(frame(seq)) if isinstance(a, Submit)]
    assert "not_this_person" in late[-1].ticket.ready.flags
    gone = [a for seq in range(40, 70) for a in stream.say(frame(seq, 5 + seq / 30))]
    flagged = [a for a in gone if isinstance(a, Submit) and a.ticket.ready.flags]
    assert not any("not_this_person" in a.ticket.ready.flags for a in flagged)


@pytest.mark.parametrize("scale", [0.8, 1.25])
def test_bones_of_another_size_are_somebody_elses(scale: float) -> None:
    for seed in range(5):
        person = SyntheticPerson(seed).record("walk", 4.0).astype(np.float64)
        known = measure_bones(person[:60])
        assert not is_stranger([measure_bones(person[60:90])], known, rules=RULES)
        assert is_stranger([measure_bones(scale * person[60:90])], known, rules=RULES)


def test_a_smaller_difference_shows_over_five_seconds() -> None:
    asked = watch(KNOWN + 0.15, 240)
    strange = ["not_this_person" in action.ticket.ready.flags for action in asked]
    first = asked[strange.index(True)].ticket.seq / 30
    assert 4.5 < first < 6
    assert all(strange[strange.index(True) :])


def look_at(poses: np.ndarray, known: np.ndarray) -> list[bool]:
    """Whether each second of a stream is taken for somebody else's."""
    likeness = Likeness(RULES)
    likeness.known = known
    times = np.arange(len(poses)) / 30
    found = []
    for i in range(0, len(poses), 2):
        first = max(0, i - 40)
        recent = poses[first : i + 1]
        found.append(likeness.look(times[first : i + 1], lambda k, recent=recent: recent[k:]))
    return found[15::15]


@pytest.mark.recordings
def test_hardly_a_second_of_ones_own_is_taken_for_somebody_elses(utd_mhad) -> None:
    people = ("1", "3", "5", "7")
    clips = load_clips(utd_mhad, subjects=people, trials=("1", "2"))
    first, second = ([clip for clip in clips if clip.trial == trial] for trial in "12")
    known = {
        name: np.median([measure_bones(c.poses) for c in first if c.subject == name], axis=0)
        for name in people
    }
    own, other = [], []
    for name in people:
        seen = np.concatenate([c.poses for c in second if c.subject == name]).astype(np.float64)
        own += look_at(seen, known[name])
        for stranger in set(people) - {name}:
            other += look_at(seen, known[stranger])
    assert len(own) > 200
    assert np.mean(own) <= 0.001
    assert np.mean(other) > 0.03
