"""Forecasts as ROS 2 messages, held against the fields of the real definitions; without ROS."""

import re

import numpy as np
import pytest
from kinecast_client.interop import ros
from kinecast_client.interop.body import KINECT_V1, to_ros
from kinecast_client.samples import waving_person

from tests.unit.clients.robots import NOW, make_forecast
from tests.unit.clients.ros_messages import check

CAMERA = ros.Camera(fx=525.0, fy=525.0, cx=319.5, cy=239.5, width=640, height=480)
PLACE = {"skeleton": KINECT_V1, "up": "y", "frame_id": "camera_link"}
POSE = waving_person(1.0)[0]


def to_seconds(stamp):
    return stamp["sec"] + stamp["nanosec"] / 1e9


def test_every_message_has_fields_and_types_of_the_real_definitions():
    forecast = make_forecast()
    check(
        ros.make_forecast_markers(forecast, body="ada", **PLACE), "visualization_msgs/MarkerArray"
    )
    check(ros.make_pose_markers(POSE, NOW, body="ada", **PLACE), "visualization_msgs/MarkerArray")
    check(ros.make_deletion("ada", NOW, "camera_link", joints=20), "visualization_msgs/MarkerArray")
    check(ros.make_trajectory(forecast, **PLACE), "trajectory_msgs/MultiDOFJointTrajectory")
    check(ros.make_ids(["ada"], NOW), "hri_msgs/IdsList")
    check(
        ros.make_joint_state(POSE, NOW, skeleton=KINECT_V1, up="y", body="ada"),
        "sensor_msgs/JointState",
    )
    check(ros.make_skeleton2d(POSE, NOW, camera=CAMERA, **PLACE), "hri_msgs/Skeleton2D")
    for transform in ros.make_transforms(POSE, NOW, body="ada", joints=True, **PLACE):
        check(transform, "geometry_msgs/TransformStamped")


def test_table_of_fields_notices_what_is_wrong():
    for wrong in ({"stamp": NOW}, {"frameid": ""}, {"frame_id": None}):
        with pytest.raises(AssertionError):
            check(wrong, "std_msgs/Header")
    with pytest.raises(AssertionError):
        check({"x": 1}, "geometry_msgs/Point")


def test_times_keep_what_a_float64_holds_and_nanoseconds_stay_below_a_second():
    assert ros.make_time(1.5) == {"sec": 1, "nanosec": 500_000_000}
    assert ros.make_time(2.9999999999) == {"sec": 3, "nanosec": 0}
    assert to_seconds(ros.make_time(NOW)) == pytest.approx(NOW, abs=3e-7)


def test_markers_carry_the_capture_time_and_the_sensors_frame():
    markers = ros.make_forecast_markers(make_forecast(), body="ada", **PLACE)["markers"]
    for marker in markers:
        assert marker["header"]["frame_id"] == "camera_link"
        assert to_seconds(marker["header"]["stamp"]) == pytest.approx(NOW, abs=1e-6)


def test_skeletons_fade_and_every_bone_is_drawn_where_it_will_be():
    forecast = make_forecast()
    markers = ros.make_forecast_markers(forecast, body="ada", **PLACE)["markers"]
    lines = [marker for marker in markers if marker["type"] == ros.LINE_LIST]
    assert [line["id"] for line in lines] == list(ros.SHOWN)
    alphas = [line["color"]["a"] for line in lines]
    assert alphas == sorted(alphas, reverse=True)
    ends = np.array([[p["x"], p["y"], p["z"]] for p in lines[-1]["points"]]).reshape(-1, 2, 3)
    bones = to_ros(forecast.frames[14], "y")[np.array(KINECT_V1.bones)]
    np.testing.assert_allclose(ends, bones)


def test_radius_is_a_ball_of_twice_its_size_around_the_last_frames_joints():
    forecast = make_forecast()
    markers = ros.make_forecast_markers(forecast, body="ada", **PLACE)["markers"]
    balls = [marker for marker in markers if marker["ns"] == "ada/radius"]
    assert len(balls) == 20
    assert balls[11]["scale"]["x"] == pytest.approx(0.14)
    assert balls[11]["pose"]["position"]["x"] == pytest.approx(float(forecast.frames[14, 11, 2]))


def test_unsafe_forecast_is_grey_and_shows_no_radius():
    markers = ros.make_forecast_markers(make_forecast(severity="unsafe"), body="ada", **PLACE)
    assert {marker["ns"] for marker in markers["markers"]} == {"ada/forecast"}
    colour = markers["markers"][0]["color"]
    assert (colour["r"], colour["g"], colour["b"]) == ros.UNSAFE_COLOUR


def test_deletion_names_every_marker_of_the_person_and_no_other():
    shown = ros.make_forecast_markers(make_forecast(), body="ada", **PLACE)["markers"]
    shown += ros.make_pose_markers(POSE, NOW, body="ada", **PLACE)["markers"]
    gone = ros.make_deletion("ada", NOW, "camera_link", joints=20)["markers"]
    assert {(m["ns"], m["id"]) for m in gone} == {(m["ns"], m["id"]) for m in shown}
    assert {m["action"] for m in gone} == {ros.DELETE}


def test_bones_of_missing_joints_are_left_out():
    pose = POSE.copy()
    pose[11] = np.nan
    [marker] = ros.make_pose_markers(pose, NOW, body="ada", **PLACE)["markers"]
    assert len(marker["points"]) == 2 * (len(KINECT_V1.bones) - 1)
    assert all(np.isfinite(list(point.values())).all() for point in marker["points"])


def test_trajectory_has_every_joint_at_every_time_from_the_newest_frame():
    forecast = make_forecast()
    made = ros.make_trajectory(forecast, **PLACE)
    assert made["joint_names"] == list(KINECT_V1.joints)
    times = [to_seconds(point["time_from_start"]) for point in made["points"]]
    assert times == pytest.approx(np.arange(1, 16) / 30, abs=1e-6)
    hand = made["points"][14]["transforms"][11]["translation"]
    assert list(hand.values()) == pytest.approx(to_ros(forecast.frames[14, 11], "y"))


def test_joints_of_a_body_end_in_its_id():
    made = ros.make_joint_state(POSE, NOW, skeleton=KINECT_V1, up="y", body="ada")
    assert len(made["name"]) == len(made["position"]) == 20
    assert all(name.endswith("_ada") for name in made["name"])
    assert "l_elbow_ada" in made["name"]


def test_skeleton2d_is_where_a_camera_sees_the_joints():
    made = ros.make_skeleton2d(POSE, NOW, camera=CAMERA, **PLACE)["skeleton"]
    right_wrist, left_wrist, neck, nose = made[4], made[7], made[1], made[0]
    assert right_wrist["x"] < 0.5 < left_wrist["x"]  # facing the camera, right is on its left
    assert right_wrist["y"] < left_wrist["y"]  # the right hand is raised, and y points down
    assert neck["c"] == 1.0
    assert nose == {"x": 0.0, "y": 0.0, "c": 0.0}
    x = (319.5 - 525 * to_ros(POSE, "y")[10, 1] / to_ros(POSE, "y")[10, 0]) / 640
    assert right_wrist["x"] == pytest.approx(x)


def test_skeleton2d_doubts_what_was_filled_or_lies_outside_of_the_picture():
    doubted = ros.make_skeleton2d(POSE, NOW, camera=CAMERA, doubted=[10, 4], **PLACE)["skeleton"]
    assert doubted[4]["c"] == 0.0
    assert doubted[1]["c"] == 0.0  # the neck is between both shoulders
    near = ros.make_skeleton2d(POSE * [1, 1, 0.1], NOW, camera=CAMERA, **PLACE)["skeleton"]
    assert near[10] == {"x": 0.0, "y": 0.0, "c": 0.0}  # the ankles are below the picture
    behind = ros.make_skeleton2d(POSE * [1, 1, -1], NOW, camera=CAMERA, **PLACE)["skeleton"]
    assert all(point["c"] == 0.0 for point in behind)


def test_body_hangs_on_the_sensor_and_its_joints_on_the_body():
    body, *joints = ros.make_transforms(POSE, NOW, body="ada", joints=True, **PLACE)
    assert (body["header"]["frame_id"], body["child_frame_id"]) == ("camera_link", "body_ada")
    assert {one["header"]["frame_id"] for one in joints} == {"body_ada"}
    assert {"head_ada", "l_wrist_ada", "r_ankle_ada"} <= {one["child_frame_id"] for one in joints}
    assert len(ros.make_transforms(POSE, NOW, body="ada", **PLACE)) == 1


@pytest.mark.parametrize("user", ["ada", "Ada_7", "7up", "a.b", "a-b", "_x"])
def test_bodies_have_names_that_topics_allow_and_share_none(user):
    users = ["ada", "Ada_7", "7up", "a.b", "a-b", "a_b", "_x"]
    assert re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", ros.name_body(user))
    assert len({ros.name_body(one) for one in users}) == len(users)
    assert ros.name_body("ada") == "ada"
    assert ros.topic("ada", "joint_states") == "/humans/bodies/ada/joint_states"
