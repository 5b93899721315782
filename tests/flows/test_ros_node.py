"""The ROS 2 node against a real service, with stand-ins for the few calls that it makes to ROS."""

import sys
import time
from types import ModuleType, SimpleNamespace

import pytest

from tests.live_support import serve
from tests.support import ADMIN_KEY, make_settings
from tests.unit.clients.examples import load_example
from tests.unit.clients.robots import make_markers, make_pose
from tests.unit.clients.ros_messages import check

FRAMES = 30


class FakeNode:
    """A node whose tracker and camera see a person for a second, whose clock is the wall's."""

    def __init__(self, name):
        self.name, self.published, self.takers, self.timers, self.qos = name, [], {}, [], {}
        self.said = []
        self.get_logger = lambda: SimpleNamespace(info=self.said.append, warning=self.said.append)

    def get_clock(self):
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=time.time_ns()))

    def create_publisher(self, kind, topic, qos):
        self.qos[topic] = qos
        return SimpleNamespace(publish=lambda message: self.published.append((topic, message)))

    def create_subscription(self, kind, topic, take, qos):
        self.takers[topic], self.qos[topic] = take, qos

    def create_timer(self, period_s, call):
        self.timers.append(call)

    def run(self):
        info = SimpleNamespace(k=[504.0, 0, 320.0, 0, 504.0, 288.0, 0, 0, 1], width=640, height=576)
        self.takers["/camera_info"](info)
        for number in range(FRAMES):
            markers = make_markers(make_pose(number=number), t=time.time())
            self.takers["/tracker"](SimpleNamespace(markers=markers))
            time.sleep(1 / 30)
        time.sleep(0.5)
        for call in self.timers:
            call()
        raise KeyboardInterrupt


class Message:
    """A message of a kind, filled as rosidl does, if its fields are those of the definition."""

    kind = ""

    def fill(self, fields):
        check(fields, self.kind)
        self.fields = fields


def get_message(name):
    return type(name, (Message,), {"kind": name.replace("/msg/", "/")})


@pytest.fixture
def ros(monkeypatch):
    nodes, sent = [], []

    def create_node(name):
        nodes.append(FakeNode(name))
        return nodes[0]

    def broadcaster(node):
        return SimpleNamespace(sendTransform=sent.extend)

    modules = {
        "rclpy": {
            "init": lambda: None,
            "create_node": create_node,
            "spin": lambda node: node.run(),
            "try_shutdown": lambda: None,
        },
        "rclpy.qos": {
            "QoSProfile": SimpleNamespace,
            "ReliabilityPolicy": SimpleNamespace(RELIABLE="reliable", BEST_EFFORT="best effort"),
        },
        "tf2_ros": {"TransformBroadcaster": broadcaster},
        "rosidl_runtime_py": {},
        "rosidl_runtime_py.utilities": {"get_message": get_message},
        "rosidl_runtime_py.set_message": {"set_message_fields": Message.fill},
    }
    for name, parts in modules.items():
        module = ModuleType(name)
        module.__dict__.update(parts)
        monkeypatch.setitem(sys.modules, name, module)
    return SimpleNamespace(nodes=nodes, transforms=sent)


def test_node_publishes_forecasts_and_takes_them_back_when_the_person_is_gone(
    ros, tmp_path, monkeypatch
):
    monkeypatch.setenv("KEY", ADMIN_KEY)
    example = load_example("ros2_node")
    with serve(make_settings(tmp_path)) as server:
        server.add_user("7up", skeleton="azure_kinect", up="-y")
        words = ["--url", server.http, "--user", "7up", "--markers", "/tracker"]
        example.main([*words, "--camera-info", "/camera_info"])
    [node] = ros.nodes
    topics = [topic for topic, _ in node.published]
    body = example.ros.name_body("7up")
    assert topics.count(f"/humans/bodies/{body}/joint_states") == FRAMES
    assert {
        "~/forecast",
        f"/humans/bodies/{body}/forecast/joint_states",
        f"/humans/bodies/{body}/forecast/skeleton2d",
    } <= set(topics)
    assert topics[-2:] == ["~/forecast_markers", "/humans/bodies/tracked"]
    assert node.published[-1][1].fields["ids"] == []
    assert {one.fields["child_frame_id"] for one in ros.transforms} == {f"body_{body}"}
    assert node.qos["/tracker"] == SimpleNamespace(depth=1, reliability="best effort")
    assert node.qos["~/forecast"] == SimpleNamespace(depth=1, reliability="reliable")


def test_node_without_ros_says_what_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "rclpy", None)
    with pytest.raises(SystemExit, match=r"setup\.bash"):
        load_example("ros2_node").main([])


def test_topics_whose_messages_are_not_installed_are_left_out(ros, monkeypatch):
    def find(name):
        if name.startswith("hri_msgs"):
            raise ModuleNotFoundError("No module named 'hri_msgs'", name="hri_msgs")
        return get_message(name)

    monkeypatch.setattr(sys.modules["rosidl_runtime_py.utilities"], "get_message", find)
    node = load_example("ros2_node").Node()
    for _ in range(2):
        node.publish("/humans/bodies/tracked", "hri_msgs/msg/IdsList", {"ids": []})
        node.publish("~/forecast", "trajectory_msgs/msg/MultiDOFJointTrajectory", {})
    assert [topic for topic, _ in node.node.published] == ["~/forecast"] * 2
    assert node.node.said == ["/humans/bodies/tracked is left out: no hri_msgs here"]
