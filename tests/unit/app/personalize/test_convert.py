import numpy as np
import pytest

from app.domain.recordings import RawFrames
from app.personalize.convert import convert_clip
from models.skeleton import HIP_CENTER, KINECT_V1, SKELETONS, from_y_up
from tests.personal_support import record_frames


def change(frames, *, t=None, joints=None, confidence=None):
    return RawFrames(
        t=frames.t if t is None else t,
        joints=frames.joints if joints is None else joints,
        confidence=confidence,
    )


def convert(frames, skeleton=KINECT_V1, up="y"):
    return convert_clip(frames, skeleton, up=up)


@pytest.mark.parametrize("start", [0.0, 1.7e9])
def test_whole_frames_on_the_grid_come_through_bit_for_bit(start):
    frames = record_frames(3.0)
    (poses,) = convert(change(frames, t=frames.t + start))
    assert np.array_equal(poses.astype(np.float32), frames.joints)


@pytest.mark.parametrize("rate_hz", [25.0, 60.0, 100.0])
def test_other_rates_give_the_same_motion(rate_hz):
    frames = record_frames(3.0)
    t = np.arange(int(2.9 * rate_hz)) / rate_hz
    joints = np.stack(
        [np.interp(t, frames.t, frames.joints[:, j, c]) for j in range(20) for c in range(3)],
        axis=1,
    ).reshape(len(t), 20, 3)
    (poses,) = convert(RawFrames(t=t, joints=joints.astype(np.float32)))
    assert np.abs(poses - frames.joints[: len(poses)]).max() < 0.012  # both lines are linear


def test_up_axis_and_order_of_joints_are_undone():
    frames = record_frames()
    sdk = SKELETONS["kinect_v1_sdk"]
    order = sdk.to_net.argmax(axis=1)
    joints = np.empty_like(frames.joints)
    joints[:, order] = frames.joints
    turned = from_y_up(joints.astype(np.float64), "z").astype(np.float32)
    (poses,) = convert(change(frames, joints=turned), sdk, "z")
    assert np.allclose(poses, frames.joints, atol=1e-6)


def test_missing_joint_is_bridged_relative_to_the_hips():
    frames = record_frames()
    joints = frames.joints.copy()
    joints[20:26, 7] = np.nan
    (poses,) = convert(change(frames, joints=joints))
    assert np.isfinite(poses).all()
    offset = poses[:, 7] - poses[:, HIP_CENTER]
    steps = np.diff(offset[19:27], axis=0)
    assert np.allclose(steps, steps[0], atol=1e-6)


def test_low_confidence_is_missing():
    frames = record_frames()
    confidence = np.ones(frames.joints.shape[:2], dtype=np.float32)
    confidence[30, 5] = 0.1
    joints = frames.joints.copy()
    joints[30, 5] += 5.0
    (poses,) = convert(change(frames, joints=joints, confidence=confidence))
    assert np.abs(np.diff(poses[:, 5], axis=0)).max() < 0.5


def test_loss_of_the_person_cuts_the_clip():
    frames = record_frames(4.0)
    joints = frames.joints.copy()
    joints[50:60] = np.nan
    first, second = convert(change(frames, joints=joints))
    assert (len(first), len(second)) == (50, len(frames) - 60)


def test_gap_cuts_and_what_is_left_must_hold_a_window():
    frames = record_frames(2.0)
    t = frames.t.copy()
    t[40:] += 1.0
    assert [len(piece) for piece in convert(change(frames, t=t))] == [40]
    joints = frames.joints.copy()
    joints[::2] = np.nan
    joints[20:40] = np.nan
    assert convert(change(frames, joints=joints)) == []


def test_short_loss_is_bridged():
    frames = record_frames()
    joints = frames.joints.copy()
    joints[30:32] = np.nan
    (poses,) = convert(change(frames, joints=joints))
    assert len(poses) == len(frames)
    assert np.isfinite(poses).all()


def test_joint_that_was_never_seen_goes_with_the_hips():
    frames = record_frames()
    joints = frames.joints.copy()
    joints[:, 0] = np.nan
    (poses,) = convert(change(frames, joints=joints))
    assert np.allclose(poses[:, 0], poses[:, HIP_CENTER])
