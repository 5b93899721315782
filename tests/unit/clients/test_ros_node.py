"""The ROS 2 node without ROS: what it sends, what it publishes where, and when it stops showing."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest
from kinecast_client.interop import ros
from kinecast_client.interop.body import Skeleton
from kinecast_client.interop.ros import Camera

from tests.unit.clients.examples import load_example
from tests.unit.clients.robots import AZURE, NOW, make_forecast, make_markers, make_pose
from tests.unit.clients.ros_messages import check

bridging, node = load_example("ros2_bridge"), load_example("ros2_node")
CAMERA = Camera(fx=504.0, fy=504.0, cx=320.0, cy=288.0, width=640, height=576)


class FakeStream:
    def __init__(self):
        self.sent, self.newest = [], None

    def send(self, joints, t=None):
        self.sent.append((joints, t))

    def latest(self):
        return self.newest


@pytest.fixture
def rig():
    published, transforms = [], []
    bridge = bridging.Bridge(
        FakeStream(),
        Skeleton(AZURE.joints, AZURE.bones),
        body="ada",
        up="-y",
        ahead=14,
        publish=lambda *message: published.append(message),
        broadcast=transforms.extend,
        camera=CAMERA,
    )
    return SimpleNamespace(bridge=bridge, published=published, transforms=transforms)


def topics(rig):
    return [topic for topic, _, _ in rig.published]


def forecast_of(pose, **changes):
    return make_forecast(np.repeat(pose[None], 15, axis=0).astype(np.float32), **changes)


def test_rclpy_is_not_needed_to_import_the_node():
    assert "rclpy" not in sys.modules


def test_frames_go_out_with_their_capture_time_and_gaps_as_missing_joints(rig):
    pose = make_pose()
    rig.bridge.observe(make_markers(pose)[1:], NOW + 0.03)
    [(sent, t)] = rig.bridge.stream.sent
    assert t == pytest.approx(NOW, abs=1e-6)
    assert np.isnan(sent[0]).all()
    np.testing.assert_array_equal(sent[1:], pose[1:])


def test_picture_of_nobody_is_a_frame_without_the_person(rig):
    rig.bridge.observe([], NOW)
    assert rig.bridge.stream.sent == [(None, NOW)]
    assert rig.published == []


def test_nearest_person_is_followed_and_kept(rig):
    near, far, away = make_pose(1.5), make_pose(3.0), make_pose(3.5)
    rig.bridge.observe(make_markers(far, 4) + make_markers(near, 7), NOW)
    rig.bridge.observe(make_markers(away, 7) + make_markers(far, 4), NOW + 0.03)
    rig.bridge.observe(make_markers(far, 4), NOW + 0.06)
    sent = [pose for pose, _ in rig.bridge.stream.sent]
    np.testing.assert_array_equal(sent[0], near)
    np.testing.assert_array_equal(sent[1], away)
    np.testing.assert_array_equal(sent[2], far)


def test_observed_body_is_announced_by_rep_155(rig):
    rig.bridge.observe(make_markers(make_pose()), NOW)
    assert topics(rig) == [
        "/humans/bodies/tracked",
        "/humans/bodies/ada/joint_states",
        "/humans/bodies/ada/skeleton2d",
    ]
    [body] = rig.transforms
    assert body["header"]["frame_id"] == "depth_camera_link"
    assert body["child_frame_id"] == "body_ada"


def test_positions_stay_in_the_trackers_frame(rig):
    pose = make_pose()
    rig.bridge.observe(make_markers(pose), NOW)
    rig.bridge.forecast(forecast_of(pose))
    [body] = rig.transforms
    hips = pose[[AZURE.joints.index("HIP_LEFT"), AZURE.joints.index("HIP_RIGHT")]].mean(axis=0)
    assert list(body["transform"]["translation"].values()) == pytest.approx(hips)
    [trajectory] = [message for topic, _, message in rig.published if topic == "~/forecast"]
    assert trajectory["header"]["frame_id"] == "depth_camera_link"
    first = trajectory["points"][0]["transforms"][0]["translation"]
    assert list(first.values()) == pytest.approx(pose[0], abs=1e-6)


def test_angles_are_the_same_in_whichever_frame_the_tracker_sees(rig):
    pose = make_pose()
    rig.bridge.observe(make_markers(pose), NOW)
    [(_, _, state)] = [one for one in rig.published if one[0].endswith("joint_states")]
    turned = ros.make_joint_state(pose, NOW, skeleton=rig.bridge.skeleton, up="-y", body="ada")
    assert state["position"] == pytest.approx(turned["position"], abs=1e-6)


def test_forecast_is_published_for_rviz_planners_and_people_aware_nodes(rig):
    rig.bridge.frame_id = "depth_camera_link"
    rig.bridge.forecast(forecast_of(make_pose()))
    assert topics(rig) == [
        "~/forecast_markers",
        "~/forecast",
        "/humans/bodies/ada/forecast/joint_states",
        "/humans/bodies/ada/forecast/skeleton2d",
    ]
    for _, kind, message in rig.published:
        check(message, kind.replace("/msg/", "/"))
    *_, (_, _, picture) = rig.published
    stamp = picture["header"]["stamp"]
    assert stamp["sec"] + stamp["nanosec"] / 1e9 == pytest.approx(NOW + 0.5, abs=1e-6)


def test_forecast_that_is_unsafe_is_shown_and_not_offered_to_planners(rig):
    rig.bridge.forecast(forecast_of(make_pose(), severity="unsafe"))
    assert topics(rig) == ["~/forecast_markers"]


def test_no_camera_means_no_picture(rig):
    rig.bridge.camera = None
    rig.bridge.observe(make_markers(make_pose()), NOW)
    assert not any("skeleton2d" in topic for topic in topics(rig))


def test_body_without_hips_is_sent_and_not_placed(rig):
    markers = [m for m in make_markers(make_pose()) if m.id % 100 != AZURE.joints.index("HIP_LEFT")]
    rig.bridge.observe(markers, NOW)
    assert len(rig.bridge.stream.sent) == 1
    assert rig.transforms == []
    assert topics(rig) == ["/humans/bodies/tracked"]


def test_markers_go_once_when_the_forecast_ends(rig):
    stream, forecast = rig.bridge.stream, forecast_of(make_pose())
    rig.bridge.check(NOW)
    assert rig.published == []
    rig.bridge.forecast(forecast)
    stream.newest = forecast
    rig.published.clear()
    rig.bridge.check(NOW)
    assert rig.published == []
    stream.newest = None
    rig.bridge.check(NOW + 0.2)
    rig.bridge.check(NOW + 0.3)
    assert topics(rig) == ["~/forecast_markers", "/humans/bodies/tracked"]
    assert rig.published[1][2]["ids"] == []


def test_command_line_leaves_ros_arguments_to_ros():
    options = node.parse(["--user", "bob", "--ros-args", "-r", "__node:=watch"])
    assert (options.user, options.up, options.markers) == ("bob", "-y", "/body_tracking_data")
    with pytest.raises(SystemExit):
        node.parse(["--ahead", "0.6"])
