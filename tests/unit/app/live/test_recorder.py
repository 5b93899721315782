"""The recording of a stream, with a database that is a list and may be away."""

from dataclasses import replace
from uuid import uuid4

import numpy as np
import pytest

from app.domain.errors import (
    FencedError,
    NotReadyError,
    TrialConflictError,
    TrialLimitError,
    UnknownTrialError,
)
from app.live.protocol import (
    ClipStart,
    ClipStop,
    Observation,
    TrialCancel,
    TrialResume,
    TrialStart,
    TrialStop,
)
from app.live.steps import Begin, Finish, Touch
from app.live.tape import to_raw
from tests.unit.app.live.recorder_rig import JOB, SMALL, Rig, begin, find_lost
from tests.unit.app.live.test_session import LIMITS


def test_a_trial_goes_from_start_to_stored_with_its_job() -> None:
    rig = begin(label="kitchen")
    assert (rig.last.state, rig.last.clip, rig.last.stored_seq) == ("recording", 0, None)
    rig.say(ClipStart("wave"))
    rig.show(range(30))
    rig.settle()
    rig.say(ClipStart("walk"))
    assert rig.last.clip == 1
    rig.show(range(30, 50))
    rig.say(TrialStop())
    rig.settle()
    assert rig.stored() == [list(range(30)), list(range(30, 50))]
    assert rig.archive.actions == {0: "wave", 1: "walk"}
    assert (rig.last.state, rig.last.stored_seq, rig.last.job) == ("stored", 49, JOB)
    assert rig.codes == []


def test_frames_are_stored_within_a_second_and_told_of() -> None:
    rig = begin()
    for seq in range(90):
        rig.show([seq])
        rig.settle()
        if seq % 30 == 29:
            rig.tick(0.0)
            rig.settle()
        waiting = seq - (-1 if rig.last.stored_seq is None else rig.last.stored_seq)
        assert waiting <= 20
    assert rig.last.stored_seq == 89


def test_repeated_messages_change_nothing() -> None:
    trial = uuid4()
    rig = begin(trial=trial)
    for message in (TrialStart(trial), TrialStart(), TrialResume(trial), ClipStart("a")):
        rig.say(message)
    rig.show(range(10))
    rig.say(ClipStart("a"))
    rig.say(TrialStart(trial))
    rig.show(range(10, 20))
    for message in (ClipStop(), ClipStop(), TrialStop(), TrialStop()):
        rig.say(message)
    rig.settle()
    before = rig.last
    for message in (TrialStop(), TrialStart(trial), TrialResume(trial)):
        rig.say(message)
        assert rig.last == before
    assert rig.stored() == [list(range(20))]
    kinds = [type(step) for step in rig.archive.steps]
    assert (kinds.count(Begin), kinds.count(Finish)) == (1, 1)
    assert rig.waiting is None


@pytest.mark.parametrize("message", [ClipStart(), ClipStop(), TrialStop(), TrialCancel()])
def test_without_a_trial_there_is_nothing_to_change(message) -> None:
    with pytest.raises(TrialConflictError):
        Rig().say(message)


def test_a_second_trial_waits_until_the_first_is_complete() -> None:
    rig = begin(trial=uuid4())
    with pytest.raises(TrialConflictError):
        rig.say(TrialStart(uuid4()))
    rig.show(range(10))
    rig.say(TrialStop())
    for message in (TrialStart(), TrialCancel(), ClipStart()):
        with pytest.raises(TrialConflictError):
            rig.say(message)
    rig.settle()
    rig.say(TrialStart())
    rig.settle()
    assert rig.last.state == "recording"


def test_a_cancelled_trial_keeps_nothing() -> None:
    rig = begin()
    rig.show(range(40))
    rig.say(TrialCancel())
    rig.show(range(40, 60))
    rig.settle()
    rig.say(TrialCancel())
    assert (rig.last.state, rig.archive.clips) == ("cancelled", {})
    with pytest.raises(TrialConflictError):
        rig.say(TrialStop())


def test_frames_between_clips_are_not_recorded() -> None:
    rig = begin()
    rig.show(range(10))
    rig.say(ClipStop())
    assert rig.last.clip is None
    rig.show(range(10, 20))
    rig.say(ClipStart())
    rig.show(range(20, 30))
    rig.say(TrialStop(finetune=False))
    rig.settle()
    assert rig.stored() == [list(range(10)), list(range(20, 30))]
    assert rig.last.job is None


def test_a_gap_or_a_jump_of_the_frame_of_reference_begins_a_new_clip() -> None:
    rig = begin()
    rig.say(ClipStart("wave"))
    rig.show(range(10))
    rig.show(range(10, 20), since=2.0, anew=True)
    rig.take(rig.recorder.cut(rig.now))
    rig.take(rig.recorder.cut(rig.now))
    rig.show(range(20, 30), since=2.0)
    rig.say(TrialStop())
    rig.settle()
    assert rig.stored() == [list(range(10)), list(range(10, 20)), list(range(20, 30))]
    assert set(rig.archive.actions.values()) == {"wave"}


def test_what_comes_while_the_trial_is_being_opened_is_recorded() -> None:
    rig = Rig()
    rig.say(TrialStart())
    rig.show(range(5))
    rig.say(ClipStart("wave"))
    rig.show(range(5, 10))
    rig.say(ClipStop())
    rig.show(range(10, 12))
    rig.say(TrialStop())
    rig.show(range(12, 15))
    rig.settle()
    assert rig.stored() == [list(range(5)), list(range(5, 10))]
    assert rig.last.state == "stored"


def test_a_resumed_recording_stores_what_is_missing_once() -> None:
    first = begin(trial=uuid4())
    first.show(range(40))
    first.settle()
    second = Rig(archive=first.archive)
    second.say(TrialResume(first.last.trial))
    second.show(range(20, 30))
    second.settle()
    assert second.last.stored_seq == first.last.stored_seq == second.recorder.floor
    second.show(range(30, 60))
    second.say(TrialStop())
    second.settle()
    assert second.stored() == [list(range(60))]


@pytest.mark.parametrize(("missing", "clips"), [(2, 1), (4, 2)])
def test_a_hole_after_a_resume_begins_a_new_clip(missing: int, clips: int) -> None:
    first = begin(trial=uuid4())
    first.show(range(20))
    first.settle()
    stored = first.archive.stored_seq + 1
    second = Rig(archive=first.archive)
    second.say(TrialResume(first.last.trial))
    second.settle()
    second.show(range(stored + missing, stored + missing + 20))
    second.say(TrialStop())
    second.settle()
    assert len(second.stored()) == clips


def test_a_clip_ends_at_its_limit_and_nothing_stored_is_lost() -> None:
    rig = begin(SMALL)
    rig.show(range(60))
    assert (rig.codes, rig.last.clip) == (["trial_limit"], None)
    for i in range(3):
        rig.say(ClipStart(str(i)))
        rig.show(range(100 + 10 * i, 110 + 10 * i))
    with pytest.raises(TrialLimitError):
        rig.say(ClipStart("one too many"))
    rig.show(range(130, 140), anew=True)
    assert rig.codes == ["trial_limit"] * 2
    rig.say(TrialStop())
    rig.settle()
    assert [len(clip) for clip in rig.stored()] == [40, 10, 10, 10]


def test_a_trial_ends_its_clip_at_the_limit_of_bytes() -> None:
    rig = begin(replace(LIMITS, trial_bytes=65_536))
    rig.show(range(300))
    assert rig.codes == ["trial_limit"]
    rig.say(TrialStop())
    rig.settle()
    (clip,) = rig.stored()
    assert len(clip) == -(-65_536 // 248)


def test_without_the_database_frames_wait_and_are_stored_later() -> None:
    rig = begin()
    rig.show(range(30))
    for i in range(5):
        rig.answer(fails=NotReadyError(), is_lost=i == 2)
        rig.tick()
        rig.show(range(30 + 10 * i, 40 + 10 * i))
    assert rig.codes == ["trial_unavailable"]
    rig.settle()
    rig.say(TrialStop())
    rig.settle()
    assert rig.stored() == [list(range(80))]
    assert rig.last.clips_dropped == 0


def test_an_outage_that_is_too_long_costs_the_oldest_frames_and_says_so() -> None:
    rig = begin()
    rig.show(range(30))
    rig.settle()
    for seq in range(30, 630, 30):
        rig.show(range(seq, seq + 30))
        rig.tick(0.0)
        if rig.waiting is not None:
            rig.answer(fails=NotReadyError())
    assert rig.recorder.waiting <= 11 * 30
    rig.settle()
    rig.tick()
    rig.say(TrialStop())
    rig.settle()
    lost = find_lost(rig)
    stored = [seq for clip in rig.stored() for seq in clip]
    assert sorted(stored + lost) == list(range(630))
    assert len(rig.stored()) == 2
    assert rig.last.clips_dropped == 1


def test_a_trial_that_cannot_begin_is_given_up() -> None:
    rig = Rig()
    rig.say(TrialStart())
    rig.show(range(30))
    for _ in range(12):
        rig.tick()
        if rig.waiting is not None:
            rig.answer(fails=NotReadyError())
    assert rig.codes == ["trial_unavailable"] * 2
    assert rig.recorder.waiting == 0
    rig.say(TrialStart())
    rig.now += 1.0
    rig.tick()
    rig.settle()
    assert rig.last.state == "recording"


def test_an_outage_is_told_to_every_recording_that_it_keeps() -> None:
    rig = Rig()
    rig.say(TrialStart())
    rig.answer(fails=NotReadyError())
    rig.tick(11.0)
    assert rig.codes == ["trial_unavailable"] * 2  # it waits; it is given up
    rig.say(TrialStart())
    rig.answer(fails=NotReadyError())
    assert rig.codes == ["trial_unavailable"] * 3
    rig.tick()
    rig.answer(fails=NotReadyError())
    assert rig.codes == ["trial_unavailable"] * 3


def test_a_stream_that_leaves_is_settled_when_nothing_is_left_to_store() -> None:
    rig = Rig()
    assert rig.recorder.is_settled
    rig.say(TrialStart())
    assert rig.recorder.is_settled  # an empty trial is no loss
    rig.settle()
    rig.show(range(10))
    rig.say(TrialStop())
    for _ in range(2):
        rig.answer(fails=NotReadyError())
        assert not rig.recorder.is_settled
        rig.take(rig.recorder.leave(rig.now))
    rig.answer()
    assert not rig.recorder.is_settled  # the end of the trial is not stored
    rig.settle()
    assert rig.recorder.is_settled


def test_a_fenced_stream_ends_and_a_lost_recording_is_told() -> None:
    rig = begin()
    rig.show(range(30))
    rig.answer(fails=FencedError())
    assert isinstance(rig.ended, FencedError)
    other = Rig()
    other.say(TrialResume(uuid4()))
    other.answer(fails=UnknownTrialError())
    assert (other.codes, other.ended) == (["unknown_trial"], None)
    with pytest.raises(TrialConflictError):
        other.say(ClipStart())


def test_a_stream_that_leaves_stores_what_it_has() -> None:
    for waits in (False, True):
        rig = Rig()
        rig.say(TrialStart())
        if not waits:
            rig.settle()
        rig.show(range(10))
        rig.take(rig.recorder.leave(rig.now))
        rig.settle()
        assert rig.stored() == [list(range(10))]
        assert rig.recorder.waiting == 0


def test_a_pause_between_clips_keeps_the_recording_alive() -> None:
    rig = begin()
    rig.say(ClipStop())
    for _ in range(25):
        rig.tick()
        rig.settle()
    assert sum(isinstance(step, Touch) for step in rig.archive.steps) == 2


def test_frames_are_kept_as_they_were_received() -> None:
    rng = np.random.default_rng(3)
    poses = rng.normal(size=(4, 20, 3)).astype(np.float32).astype(np.float64)
    poses[1, 3] = np.nan
    sure = rng.random(20).astype(np.float32).astype(np.float64)
    frames = (
        Observation(1, 0.1, poses[0], None, replay=False),
        Observation(2, 1.7e9, poses[1], sure, replay=False),
        Observation(3, 1.7e9 + 0.01, None, None, replay=True),
    )
    raw = to_raw(frames, joints=20)
    assert raw.t.tolist() == [0.1, 1.7e9, 1.7e9 + 0.01]
    assert np.array_equal(raw.joints[:2], poses[:2].astype(np.float32), equal_nan=True)
    assert np.isnan(raw.joints[2]).all()
    assert np.array_equal(raw.confidence[1], sure.astype(np.float32))
    assert (raw.confidence[[0, 2]] == 1).all()
    assert to_raw(frames[:1], joints=20).confidence is None
