"""Which joint is which, ROS's axes, the body's frame, and the angles of REP 155's human."""

import numpy as np
import pytest
from kinecast_client.interop.body import (
    KINECT_V1,
    Skeleton,
    UnknownJointError,
    find_body,
    to_quaternion,
    to_ros,
)
from kinecast_client.interop.human import JOINTS, find_angles
from kinecast_client.samples import waving_person
from scipy.spatial.transform import Rotation

from models.data.synthetic import SyntheticPerson
from models.skeleton import KINECT_V1 as NET
from models.skeleton import SKELETONS, from_y_up

AXES = {
    "l_y_shoulder": (0, 0, -1),
    "l_p_shoulder": (1, 0, 0),
    "l_r_shoulder": (0, 0, 1),
    "l_elbow": (0, -1, 0),
    "r_y_shoulder": (0, 0, 1),
    "r_p_shoulder": (-1, 0, 0),
    "r_r_shoulder": (0, 0, -1),
    "r_elbow": (0, -1, 0),
    "l_y_hip": (0, 0, -1),
    "l_p_hip": (1, 0, 0),
    "l_r_hip": (0, -1, 0),
    "l_knee": (0, -1, 0),
    "r_y_hip": (0, 0, -1),
    "r_p_hip": (-1, 0, 0),
    "r_r_hip": (0, -1, 0),
    "r_knee": (0, -1, 0),
    "r_head": (1, 0, 0),
    "y_head": (0, 0, 1),
    "p_head": (0, -1, 0),
}
"""Axes of the joints in the URDF of ros4hri/human_description."""
CHAINS = {
    ("shoulder", "elbow", "wrist"): ("y_shoulder", "p_shoulder", "r_shoulder", "elbow"),
    ("hip", "knee", "ankle"): ("y_hip", "p_hip", "r_hip", "knee"),
}


def turn(angles, names):
    product = Rotation.identity()
    for name in names:
        product = product * Rotation.from_rotvec(angles[name] * np.array(AXES[name], float))
    return product


def unit(way):
    return way / np.linalg.norm(way, axis=-1, keepdims=True)


def record(action="wave", seed=1):
    return SyntheticPerson(seed).record(action, 2.0).astype(np.float64)[::7]


def test_kinect_v1_is_the_services_own():
    assert KINECT_V1.joints == NET.joints
    assert {frozenset(bone) for bone in KINECT_V1.bones} == {frozenset(b) for b in NET.bones}


@pytest.mark.parametrize("name", sorted(SKELETONS))
def test_every_format_has_the_limbs_of_rep_155(name):
    theirs = SKELETONS[name]
    roles = Skeleton(theirs.joints, theirs.bones).roles
    assert len(roles) == 13
    for side, word in (("l", "left"), ("r", "right")):
        joint = theirs.joints[roles[f"{side}_elbow"]].lower()
        assert word in joint or joint.startswith(side)


def test_unknown_joint_is_named():
    with pytest.raises(UnknownJointError, match="l_hip"):
        Skeleton(("head",), ()).role("l_hip")


@pytest.mark.parametrize("up", ["y", "-y", "z"])
def test_axes_become_those_of_rep_103_as_the_service_understands_them(up):
    poses = record()
    np.testing.assert_allclose(to_ros(from_y_up(poses, up), up), from_y_up(poses, "z"), atol=1e-12)


def test_person_before_a_kinect_is_ahead_and_their_right_is_to_the_left():
    pose = to_ros(waving_person(1.0)[0], "y")
    assert pose[3] == pytest.approx([2.5, 0.0, 0.0], abs=0.03)
    assert pose[0, 2] > pose[3, 2]  # z is up
    assert pose[KINECT_V1.role("r_wrist"), 1] > pose[KINECT_V1.role("l_wrist"), 1]  # y is left


def test_another_up_is_refused():
    with pytest.raises(ValueError, match="up must be"):
        to_ros(np.zeros(3), "x")


def test_body_frame_lies_between_the_hips_looks_forward_and_rises_to_the_head():
    pose = to_ros(waving_person(1.0)[0], "y")
    frame = find_body(pose, KINECT_V1)
    assert frame.origin == pytest.approx((pose[12] + pose[16]) / 2)
    assert np.linalg.det(frame.axes) == pytest.approx(1.0)
    assert frame.axes[:, 0] == pytest.approx([-1, 0, 0], abs=0.1)  # towards the sensor
    assert frame.axes[:, 2] == pytest.approx([0, 0, 1], abs=0.1)
    local = frame.localise(pose)
    assert local[0, 2] > 0.5  # head
    assert local[KINECT_V1.role("l_hip"), 1] > 0  # left is left


def test_body_that_cannot_be_seen_is_an_error():
    pose = to_ros(waving_person(1.0)[0], "y")
    pose[KINECT_V1.role("l_hip")] = np.nan
    with pytest.raises(ValueError, match="hips"):
        find_body(pose, KINECT_V1)


def test_quaternions_are_those_of_scipy():
    for rotation in Rotation.random(50, rng=np.random.default_rng(5)):
        theirs = rotation.as_quat(canonical=True)
        assert to_quaternion(rotation.as_matrix()) == pytest.approx(theirs, abs=1e-9)


@pytest.mark.parametrize("action", ["wave", "walk", "squat"])
@pytest.mark.parametrize("side", ["l", "r"])
@pytest.mark.parametrize("parts", sorted(CHAINS))
def test_urdf_with_these_angles_points_its_limbs_as_observed(action, side, parts):
    names = [f"{side}_{name}" for name in CHAINS[parts]]
    for pose in to_ros(record(action), "y"):
        angles = find_angles(pose, KINECT_V1)
        local = find_body(pose, KINECT_V1).localise(pose)
        a, b, c = (local[KINECT_V1.role(f"{side}_{part}")] for part in parts)
        down = np.array([0.0, 0.0, -1.0])
        assert turn(angles, names[:3]).apply(down) == pytest.approx(unit(b - a), abs=0.02)
        assert turn(angles, names).apply(down) == pytest.approx(unit(c - b), abs=0.04)


def test_urdf_with_these_angles_holds_its_head_as_observed():
    pose = to_ros(record()[3], "y")
    angles = find_angles(pose, KINECT_V1)
    local = find_body(pose, KINECT_V1).localise(pose)
    way = unit(local[0] - (local[4] + local[8]) / 2)
    held = turn(angles, ["r_head", "y_head", "p_head"]).apply([0.0, 0.0, 1.0])
    assert held == pytest.approx(way, abs=1e-6)


def test_elbows_bend_forward_and_knees_backward_as_the_urdf_allows():
    for action in ("wave", "walk", "squat"):
        for pose in to_ros(record(action), "y"):
            angles = find_angles(pose, KINECT_V1)
            assert all(0 <= angles[f"{side}_elbow"] <= np.pi for side in "lr")
            assert all(-2.8 <= angles[f"{side}_knee"] < 0.35 for side in "lr")


def test_limbs_that_are_missing_rest_at_zero():
    pose = to_ros(record()[0], "y")
    pose[KINECT_V1.role("l_elbow")] = np.nan
    angles = find_angles(pose, KINECT_V1)
    assert set(angles) == set(JOINTS)
    assert all(angles[f"l_{name}"] == 0 for name in CHAINS["shoulder", "elbow", "wrist"])
    assert angles["r_elbow"] != 0
    assert np.isfinite(list(angles.values())).all()
