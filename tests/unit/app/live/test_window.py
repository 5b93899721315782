import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from app.domain.errors import (
    BadFrameError,
    BadTimeUnitError,
    GapInHistoryError,
    PersonLostError,
    TimeNotIncreasingError,
    TooLittleHistoryError,
    WrongJointCountError,
)
from app.live.window import FrameBuffer, Waiting, WindowReady, assemble
from models.data.synthetic import SyntheticPerson
from models.skeleton import KINECT_V1, SKELETONS, from_y_up

LEFT_WRIST, HIP = 6, 3
PERFORMANCE = SyntheticPerson(3).perform(("walk",))
PERSON = SyntheticPerson(3).record("walk", 3.0).astype(np.float64)


def push_all(frames, times, buffer: FrameBuffer | None = None) -> FrameBuffer:
    buffer = buffer or FrameBuffer(KINECT_V1)
    for pose, t in zip(frames, times, strict=True):
        buffer.push(float(t), pose)
    return buffer


def ready(buffer: FrameBuffer) -> WindowReady:
    outcome = buffer.look()
    assert isinstance(outcome, WindowReady), outcome
    return outcome


def waiting(buffer: FrameBuffer) -> Waiting:
    outcome = buffer.look()
    assert isinstance(outcome, Waiting)
    return outcome


def test_at_30_hz_the_window_is_the_last_15_frames_bit_for_bit() -> None:
    made = assemble(PERSON[:40], None, None, skeleton=KINECT_V1, up="y")
    assert np.array_equal(made.window, PERSON[25:40])
    assert np.array_equal(made.last_joints, PERSON[39])
    assert made.t == 0.0
    assert made.flags == ()


@pytest.mark.parametrize("offset", [1.7e9, -3.3e5, 0.123])
def test_the_epoch_of_the_clock_changes_nothing(offset: float) -> None:
    times = np.arange(40) / 30
    here, there = push_all(PERSON[:40], times), push_all(PERSON[:40], times + offset)
    assert np.array_equal(ready(here).window, ready(there).window)
    odd = np.cumsum(np.random.default_rng(1).uniform(0.02, 0.05, 40))
    a, b = push_all(PERSON[:40], odd), push_all(PERSON[:40], odd + offset)
    np.testing.assert_allclose(ready(a).window, ready(b).window, atol=1e-5)


def test_every_rate_gives_nearly_the_same_window() -> None:
    windows = []
    for rate in (12, 25, 30, 60, 100, 120):
        times = 2.0 - np.arange(int(1.2 * rate), -1, -1) / rate
        windows.append(ready(push_all(PERFORMANCE.pose_at(times), times)).window)
    for window in windows[1:]:
        assert np.linalg.norm(window - windows[2], axis=-1).max() < 0.005


def test_a_window_is_complete_at_45_hundredths_of_a_second() -> None:
    buffer = push_all(PERSON[:14], np.arange(14) / 30)
    short = waiting(buffer)
    assert (short.reason, short.need_s) == ("warm_up", 0.45)
    assert short.have_s == pytest.approx(13 / 30)
    buffer.push(14 / 30, PERSON[14])
    ready(buffer)


def test_a_frame_that_is_missing_is_bridged_and_a_longer_hole_is_flagged() -> None:
    times = np.arange(40) / 30
    keep = np.ones(40, dtype=bool)
    keep[30:32] = False
    bridged = ready(push_all(PERSON[:40][keep], times[keep]))
    assert bridged.flags == ()
    line = PERSON[29] + (PERSON[32] - PERSON[29]) / 3
    np.testing.assert_allclose(bridged.window[5], line, atol=1e-9)
    keep[32] = False
    assert "gap" in ready(push_all(PERSON[:40][keep], times[keep])).flags


def test_a_gap_or_a_new_clock_empties_the_window() -> None:
    buffer = push_all(PERSON[:20], np.arange(20) / 30)
    assert buffer.push(5.0, PERSON[20]) == "gap"
    assert waiting(buffer).reason == "gap"
    assert buffer.push(1.0, PERSON[21]) == "clock_restart"
    assert waiting(buffer).reason == "clock_restart"
    push_all(PERSON[22:40], 1.0 + np.arange(1, 19) / 30, buffer)
    ready(buffer)


@pytest.mark.parametrize("step", [0.0, -0.5, -1.0])
def test_a_time_that_does_not_increase_changes_nothing(step: float) -> None:
    buffer = push_all(PERSON[:20], np.arange(20) / 30)
    before = ready(buffer)
    with pytest.raises(TimeNotIncreasingError):
        buffer.push(19 / 30 + step, PERSON[20])
    assert np.array_equal(ready(buffer).window, before.window)


def test_a_short_miss_of_a_joint_passes_and_a_longer_one_is_listed() -> None:
    buffer = push_all(PERSON[:20], np.arange(20) / 30)
    for i in range(20, 23):
        hidden = PERSON[i].copy()
        hidden[LEFT_WRIST] = np.nan
        buffer.push(i / 30, hidden)
        outcome = ready(buffer)
        assert np.isfinite(outcome.window).all()
        assert outcome.filled == ()
    buffer.push(23 / 30, hidden)
    assert ready(buffer).filled == ("left_wrist",)
    assert "filled_joints" in ready(buffer).flags
    push_all(PERSON[24:40], np.arange(24, 40) / 30, buffer)
    assert ready(buffer).filled == ()


def test_a_joint_that_comes_back_does_not_jump() -> None:
    frames = PERSON[:40].copy()
    frames[30:37, LEFT_WRIST] = np.nan
    outcome = ready(push_all(frames, np.arange(40) / 30))
    assert outcome.filled == ("left_wrist",)
    steps = np.linalg.norm(np.diff(outcome.window[:, LEFT_WRIST], axis=0), axis=-1)
    truth = np.linalg.norm(np.diff(PERSON[20:40, LEFT_WRIST], axis=0), axis=-1)
    assert steps.max() < 2 * truth.max()


def test_what_is_carried_moves_with_the_hips() -> None:
    frames = np.repeat(PERSON[:1], 60, axis=0) + np.arange(60)[:, None, None] * [0.02, 0.0, 0.0]
    frames[25:, LEFT_WRIST] = np.nan
    outcome = ready(push_all(frames, np.arange(60) / 30))
    truth = PERSON[0, LEFT_WRIST] + [0.02 * 59, 0.0, 0.0]
    np.testing.assert_allclose(outcome.last_joints[LEFT_WRIST], truth, atol=1e-9)


def test_a_joint_that_was_never_seen_is_put_where_its_neighbour_is() -> None:
    frames = PERSON[:20].copy()
    frames[:, 15] = np.nan
    outcome = ready(push_all(frames, np.arange(20) / 30))
    assert np.array_equal(outcome.last_joints[15], outcome.last_joints[14])
    assert outcome.filled == ("left_foot",)


def test_low_confidence_is_a_missing_joint_and_many_are_flagged() -> None:
    buffer = push_all(PERSON[:20], np.arange(20) / 30)
    confidence = np.ones(20)
    confidence[:5] = [0.2, 0.4, 1.0, 1.0, 0.4]
    moved = PERSON[20].copy()
    moved[0] += 5.0
    buffer.push(20 / 30, moved, confidence)
    assert np.abs(ready(buffer).last_joints[0] - PERSON[19][0]).max() < 0.1
    assert "low_confidence" not in ready(buffer).flags
    confidence[5:7] = 0.4
    buffer.push(21 / 30, PERSON[21], confidence)
    assert "low_confidence" in ready(buffer).flags


def test_without_hips_or_most_joints_there_is_no_forecast() -> None:
    hidden = PERSON.copy()
    hidden[:, HIP] = np.nan
    buffer = push_all(PERSON[:20], np.arange(20) / 30)
    push_all(hidden[20:23], np.arange(20, 23) / 30, buffer)
    ready(buffer)
    buffer.push(23 / 30, hidden[23])
    assert waiting(buffer).reason == "person_lost"
    buffer.push(24 / 30, PERSON[24])
    assert "hip_center" in ready(buffer).filled
    hidden[25, :11] = np.nan
    buffer.push(25 / 30, hidden[25])
    assert waiting(buffer).reason == "person_lost"
    buffer.push(26 / 30, None)
    assert waiting(buffer).reason == "person_lost"


def test_a_person_who_was_away_starts_anew() -> None:
    buffer = push_all(PERSON[:20], np.arange(20) / 30)
    push_all([None] * 16, np.arange(20, 36) / 30, buffer)
    buffer.push(36 / 30, PERSON[36])
    back = waiting(buffer)
    assert (back.reason, back.have_s) == ("person_lost", 0.0)


def test_ten_identical_poses_are_frozen_input() -> None:
    buffer = push_all(PERSON[:20], np.arange(20) / 30)
    for i in range(20, 29):
        buffer.push(i / 30, PERSON[20])
        assert "frozen_input" not in ready(buffer).flags
    buffer.push(29 / 30, PERSON[20])
    assert "frozen_input" in ready(buffer).flags


@pytest.mark.parametrize("unit", [1e3, 1e6, 1e-2])
def test_times_in_another_unit_are_noticed(unit: float) -> None:
    times = np.arange(20) / 30 * unit
    assert push_all(PERSON[:20], times).time_unit_is_wrong
    assert not push_all(PERSON[:20], np.arange(20) / 30).time_unit_is_wrong
    with pytest.raises(BadTimeUnitError):
        assemble(PERSON[:20], times, None, skeleton=KINECT_V1, up="y")


@pytest.mark.parametrize(
    ("frames", "t", "confidence", "error"),
    [
        (PERSON[:14], None, None, TooLittleHistoryError),
        (PERSON[:0], None, None, TooLittleHistoryError),
        (PERSON[:15, :19], None, None, WrongJointCountError),
        (PERSON[:15] * np.inf, None, None, BadFrameError),
        (PERSON[:15] * 1e3, None, None, BadFrameError),
        (PERSON[:15], np.arange(14) / 30, None, BadFrameError),
        (PERSON[:15], np.full(15, np.nan), None, BadFrameError),
        (PERSON[:15], -np.arange(15) / 30, None, TimeNotIncreasingError),
        (PERSON[:15], None, np.full((15, 20), np.nan), BadFrameError),
        (PERSON[:15], None, np.full((15, 20), 1.5), BadFrameError),
        (PERSON[:15], None, np.ones((14, 20)), BadFrameError),
        (PERSON[:15], None, np.ones((15, 19)), BadFrameError),
        (PERSON[:15], None, np.full((15, 20), 0.1), PersonLostError),
        (np.full((15, 20, 3), np.nan), None, None, PersonLostError),
    ],
)
def test_arrays_that_make_no_window_are_refused(frames, t, confidence, error) -> None:
    with pytest.raises(error):
        assemble(frames, t, confidence, skeleton=KINECT_V1, up="y")


def test_a_gap_before_too_few_frames_is_named() -> None:
    times = np.r_[np.arange(20) / 30, 5 + np.arange(5) / 30]
    with pytest.raises(GapInHistoryError):
        assemble(PERSON[:25], times, None, skeleton=KINECT_V1, up="y")


@pytest.mark.parametrize("up", ["y", "-y", "z"])
def test_the_window_is_in_the_nets_frame_and_the_last_joints_in_the_users(up: str) -> None:
    turned = from_y_up(PERSON[:20], up)
    made = assemble(turned, None, None, skeleton=KINECT_V1, up=up)
    np.testing.assert_allclose(made.window, PERSON[5:20], atol=1e-12)
    assert np.array_equal(made.last_joints, turned[-1])


@pytest.mark.parametrize("name", sorted(SKELETONS))
def test_every_format_gives_a_finite_window(name: str) -> None:
    skeleton = SKELETONS[name]
    frames = PERSON[:20][:, skeleton.carry]
    frames[:, -1] = np.nan
    made = assemble(frames, None, None, skeleton=skeleton, up="y")
    assert np.isfinite(made.window).all()
    assert np.isfinite(made.last_joints).all()
    assert ("root_relative" in made.flags) == skeleton.root_relative


@given(
    steps=st.lists(st.floats(0.005, 0.3), min_size=5, max_size=60),
    holes=st.lists(st.tuples(st.integers(0, 59), st.integers(0, 19)), max_size=200),
    lost=st.sets(st.integers(0, 59), max_size=10),
)
@settings(max_examples=60, deadline=None)
def test_whatever_is_missing_the_window_stays_near_the_person(steps, holes, lost) -> None:
    frames = PERSON[: len(steps)].copy()
    for frame, joint in holes:
        if frame < len(frames):
            frames[frame, joint] = np.nan
    buffer = FrameBuffer(KINECT_V1)
    for i, t in enumerate(np.cumsum(steps)):
        buffer.push(float(t), None if i in lost else frames[i])
        outcome = buffer.look()
        if isinstance(outcome, WindowReady):
            assert np.isfinite(outcome.window).all()
            assert np.isfinite(outcome.last_joints).all()
            far = np.linalg.norm(outcome.window - outcome.window[:, HIP : HIP + 1], axis=-1)
            assert far.max() < 2.0


def test_a_joint_seen_only_long_ago_is_carried_as_on_a_stream() -> None:
    """600 frames may come in a request; where a joint was last seen may be hundreds back."""
    frames = np.repeat(PERSON[:40], 6, axis=0)[:240] + 0.0
    t = np.arange(240) / 120
    frames[60:, 11] = np.nan
    buffer = FrameBuffer(KINECT_V1, up="y")
    for when, pose in zip(t, frames, strict=True):
        buffer.push(float(when), pose, None)
    streamed = buffer.look()
    asked = assemble(frames, t, None, skeleton=KINECT_V1, up="y")
    assert isinstance(streamed, WindowReady)
    np.testing.assert_allclose(asked.window, streamed.window, atol=1e-9)
    assert asked.filled == streamed.filled
