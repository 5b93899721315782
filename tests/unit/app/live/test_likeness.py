"""Who is in front of the sensor: the person whose weights are used, or somebody else."""

import numpy as np
import pytest

from app.domain.body import GuardRules, is_stranger, measure_bones
from app.domain.motion import VersionStamp
from app.live.actions import Submit
from app.live.protocol import Configure, Forecast
from app.live.work import Choice
from models.baselines import ZeroVelocity
from models.data import utd_mhad as recordings
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
        assert not is_stranger(measure_bones(person[60:90]), known, rules=RULES)
        assert is_stranger(measure_bones(scale * person[60:90]), known, rules=RULES)


@pytest.mark.recordings
def test_hardly_a_second_of_ones_own_is_taken_for_somebody_elses(utd_mhad) -> None:
    clips: dict[str, list[np.ndarray]] = {}
    later: dict[str, list[np.ndarray]] = {}
    for path in recordings.find_mats(utd_mhad)[::3]:
        about = recordings.parse_name(path.name)
        poses = recordings.read_mat(path).astype(np.float64)
        (clips if about.trial == "1" else later).setdefault(about.subject, []).append(poses)
    known = {
        subject: np.median([measure_bones(poses) for poses in mine], axis=0)
        for subject, mine in clips.items()
    }
    own, other = [], []
    for subject, mine in later.items():
        seconds = [poses[i : i + 30] for poses in mine for i in range(0, len(poses) - 30, 30)]
        for bones in map(measure_bones, seconds):
            own.append(is_stranger(bones, known[subject], rules=RULES))
            strangers = [known[name] for name in known if name != subject]
            other += [is_stranger(bones, theirs, rules=RULES) for theirs in strangers]
    assert np.mean(own) < 0.02
    assert np.mean(other) > 0.15
