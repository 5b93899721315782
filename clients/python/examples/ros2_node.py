"""A ROS 2 node: skeletons of a body tracker in, forecasts out.

It listens to the markers of a body tracker (`visualization_msgs/MarkerArray` with the id
100 · body + joint, as the drivers of the Azure Kinect publish them) and follows one person.
It publishes

  ~/forecast_markers                        visualization_msgs/MarkerArray   for RViz
  ~/forecast                                trajectory_msgs/MultiDOFJointTrajectory, for planners
  /humans/bodies/tracked                    hri_msgs/IdsList
  /humans/bodies/<id>/joint_states          sensor_msgs/JointState           as observed
  /humans/bodies/<id>/skeleton2d            hri_msgs/Skeleton2D              as observed
  /humans/bodies/<id>/forecast/joint_states the same, --ahead seconds later
  /humans/bodies/<id>/forecast/skeleton2d
  TF: <sensor's frame> -> body_<id>         as observed

by REP 155 (people) and REP 103 (units, axes of the body). Positions stay in the frame of the
tracker's markers, which TF knows; where that is in the robot (REP 105) is the driver's business.
Skeletons in the picture need --camera-info. Publishers are reliable and keep the last message only,
so that a slow subscriber gets what is new; the tracker is listened to with best effort, which takes
any publisher.

  KEY=kc_... python3 ros2_node.py --user ada --markers /body_tracking_data

The user has the skeleton `azure_kinect` and `up` "-y" (optical frame). Forecasts are for planning;
they are not a safety function.
"""

import argparse
from collections.abc import Sequence
from typing import Any

from common import find_skeleton, make_parser, read_key, run
from ros2_bridge import MARKERS, Bridge

from kinecast_client import Client, Stream
from kinecast_client.forecasts import Forecast
from kinecast_client.interop import ros

CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
TRANSFORM = "geometry_msgs/msg/TransformStamped"


def parse(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """Read the command line."""
    parser = make_parser(__doc__)
    parser.add_argument("--markers", default="/body_tracking_data", help="topic of the tracker")
    parser.add_argument("--camera-info", help="topic of the camera that the tracker looks through")
    parser.add_argument("--up", default="-y", choices=["y", "-y", "z"], help="the user's")
    parser.add_argument("--ahead", type=float, default=0.5, help="seconds, up to 0.5")
    options, _ = parser.parse_known_args(arguments)  # the rest is --ros-args
    if not 1 / 30 <= options.ahead <= 0.5:
        parser.error("--ahead must lie between 0.034 and 0.5")
    return options


class Node:
    """A ROS node and its publishers. All that needs ROS is imported in here."""

    def __init__(self) -> None:
        import rclpy  # noqa: PLC0415 - everything else works without ROS
        from rclpy.qos import QoSProfile, ReliabilityPolicy  # noqa: PLC0415
        from tf2_ros import TransformBroadcaster  # noqa: PLC0415

        rclpy.init()
        self.node = rclpy.create_node("kinecast")
        self._newest = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)
        self._lenient = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        self._publishers: dict[str, Any] = {}
        self._transforms = TransformBroadcaster(self.node)

    def now(self) -> float:
        """Give ROS time in seconds."""
        return float(self.node.get_clock().now().nanoseconds * 1e-9)

    def publish(self, topic: str, kind: str, fields: ros.Message) -> None:
        """Publish a message; the first one on a topic announces it.

        A topic whose messages are not installed, `hri_msgs` for example, is left out.
        """
        if topic not in self._publishers:
            self._publishers[topic] = self._announce(topic, kind)
        publisher = self._publishers[topic]
        if publisher is not None:
            publisher.publish(_fill(kind, fields))

    def _announce(self, topic: str, kind: str) -> Any:
        try:
            return self.node.create_publisher(_find_type(kind), topic, self._newest)
        except ModuleNotFoundError as error:
            self.node.get_logger().warning(f"{topic} is left out: no {error.name} here")
            return None

    def broadcast(self, transforms: list[ros.Message]) -> None:
        """Send transforms to TF."""
        self._transforms.sendTransform([_fill(TRANSFORM, fields) for fields in transforms])

    def listen(self, topic: str, kind: str, take: Any) -> None:
        """Have a function called with every message of a topic."""
        self.node.create_subscription(_find_type(kind), topic, take, self._lenient)

    def spin(self) -> None:
        """Run until somebody interrupts it."""
        import rclpy  # noqa: PLC0415

        try:
            rclpy.spin(self.node)
        except KeyboardInterrupt:
            self.node.get_logger().info("stopped")
        rclpy.try_shutdown()


class Program:
    """The stream, the node, and the bridge between them."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.options, self.node = options, Node()
        self.bridge: Bridge | None = None

    def run(self) -> None:
        """Open the stream, listen to the tracker, publish."""
        options, node = self.options, self.node
        with Client(options.url, read_key()) as client:
            made = client.stream(options.user, on_forecast=self._take_forecast, clock=node.now)
            with made as stream:
                self.bridge = self._make_bridge(stream)
                node.listen(options.markers, MARKERS, self._take_markers)
                if options.camera_info:
                    node.listen(options.camera_info, CAMERA_INFO, self._take_camera)
                node.node.create_timer(0.1, self._check)
                node.spin()

    def _make_bridge(self, stream: Stream) -> Bridge:
        return Bridge(
            stream,
            find_skeleton(self.options.url, stream.joints),
            body=ros.name_body(self.options.user),
            up=self.options.up,
            ahead=round(self.options.ahead * 30) - 1,
            publish=self.node.publish,
            broadcast=self.node.broadcast,
        )

    def _take_markers(self, message: Any) -> None:
        if self.bridge is not None:
            self.bridge.observe(message.markers, self.node.now())

    def _take_camera(self, info: Any) -> None:
        fx, _, cx, _, fy, cy = info.k[:6]
        if self.bridge is not None:
            self.bridge.camera = ros.Camera(fx, fy, cx, cy, info.width, info.height)

    def _take_forecast(self, forecast: Forecast) -> None:
        if self.bridge is not None:
            self.bridge.forecast(forecast)

    def _check(self) -> None:
        if self.bridge is not None:
            self.bridge.check(self.node.now())


def _find_type(kind: str) -> Any:
    from rosidl_runtime_py.utilities import get_message  # noqa: PLC0415

    return get_message(kind)


def _fill(kind: str, fields: ros.Message) -> Any:
    from rosidl_runtime_py.set_message import set_message_fields  # noqa: PLC0415

    message = _find_type(kind)()
    set_message_fields(message, fields)
    return message


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the node."""
    options = parse(arguments)
    try:
        program = Program(options)
    except ModuleNotFoundError as error:
        why = f"{error.name} is missing: source /opt/ros/<distribution>/setup.bash"
        raise SystemExit(why) from None
    program.run()


if __name__ == "__main__":
    run(main)
