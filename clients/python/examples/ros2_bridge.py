"""From a body tracker's markers to ROS 2's topics, by way of a stream. Knows nothing of rclpy."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from kinecast_client.forecasts import Forecast
from kinecast_client.interop import ros
from kinecast_client.interop.body import Skeleton, UnknownJointError

MARKERS = "visualization_msgs/msg/MarkerArray"
TRAJECTORY = "trajectory_msgs/msg/MultiDOFJointTrajectory"
IDS = "hri_msgs/msg/IdsList"
JOINTS = "sensor_msgs/msg/JointState"
SKELETON = "hri_msgs/msg/Skeleton2D"
Publish = Callable[[str, str, ros.Message], None]
"""Sends a message: topic, type, and fields as a dict."""


class Stream(Protocol):
    """What the bridge needs of a stream."""

    def send(self, joints: NDArray[np.floating] | None, t: float | None = None) -> int | None:
        """Send a frame."""
        ...

    def latest(self) -> Forecast | None:
        """Give the newest forecast that may be used."""
        ...


def collect_bodies(markers: Iterable[Any], joints: int) -> dict[int, NDArray[np.float64]]:
    """Sort a tracker's markers by body: [joint, 3] each, NaN for a joint without a marker."""
    bodies: dict[int, NDArray[np.float64]] = {}
    for marker in markers:
        body, joint = divmod(marker.id, 100)
        if joint < joints:
            place = marker.pose.position
            pose = bodies.setdefault(body, np.full((joints, 3), np.nan))
            pose[joint] = (place.x, place.y, place.z)
    return bodies


@dataclass
class Bridge:
    """Follows one person from the tracker to the topics.

    Attributes:
        stream: of the user.
        skeleton: the user's.
        body: the id that the person has in ROS.
        up: the user's, which is how the tracker's frame lies: "-y" for an optical one.
        ahead: the frame of a forecast that becomes a skeleton, counted from 0.
        publish: sends messages.
        broadcast: sends transforms.
        camera: for skeletons in the picture; without it there are none.
    """

    stream: Stream
    skeleton: Skeleton
    body: str
    up: str
    ahead: int
    publish: Publish
    broadcast: Callable[[list[ros.Message]], None]
    camera: ros.Camera | None = None
    frame_id: str = ""
    _followed: int | None = None
    _shown_at: float | None = field(default=None, repr=False)

    def observe(self, markers: Sequence[Any], now: float) -> None:
        """Take one picture of the tracker: send it, and say where the person is.

        Args:
            markers: `markers` of its message; empty where it sees nobody.
            now: seconds of ROS time, for a picture of nobody.
        """
        bodies = collect_bodies(markers, len(self.skeleton.joints))
        pose = self._choose(bodies)
        if pose is None:
            self.stream.send(None, now)
            return
        stamp = markers[0].header.stamp
        t = stamp.sec + stamp.nanosec * 1e-9
        self.frame_id = markers[0].header.frame_id
        self.stream.send(pose, t)
        self.publish("/humans/bodies/tracked", IDS, ros.make_ids([self.body], t))
        self._publish_skeletons("", pose, t)
        try:
            self.broadcast(ros.make_transforms(pose, t, body=self.body, **self._place))
        except (UnknownJointError, ValueError):
            return  # hips or shoulders are hidden: no body to be placed

    def forecast(self, forecast: Forecast) -> None:
        """Publish a forecast."""
        self._shown_at = forecast.t_observed
        markers = ros.make_forecast_markers(forecast, body=self.body, **self._place)
        self.publish("~/forecast_markers", MARKERS, markers)
        if not forecast.is_usable:
            return
        self.publish("~/forecast", TRAJECTORY, ros.make_trajectory(forecast, **self._place))
        pose, t = forecast.frames[self.ahead], float(forecast.t[self.ahead])
        doubted = [self.skeleton.joints.index(name) for name in forecast.filled]
        self._publish_skeletons("forecast/", pose, t, doubted=doubted)

    def check(self, now: float) -> None:
        """Take markers and person away where there is no forecast any more."""
        if self._shown_at is None or self.stream.latest() is not None:
            return
        self._shown_at = None
        joints = len(self.skeleton.joints)
        gone = ros.make_deletion(self.body, now, self.frame_id, joints=joints)
        self.publish("~/forecast_markers", MARKERS, gone)
        self.publish("/humans/bodies/tracked", IDS, ros.make_ids([], now))

    @property
    def _place(self) -> dict[str, Any]:
        """Positions stay in the tracker's frame, which TF knows: "z" turns nothing."""
        return {"skeleton": self.skeleton, "up": "z", "frame_id": self.frame_id}

    def _choose(self, bodies: dict[int, NDArray[np.float64]]) -> NDArray[np.float64] | None:
        """Stay with the person that was followed; else take the nearest."""
        if not bodies:
            return None
        if self._followed not in bodies:
            self._followed = min(bodies, key=lambda body: float(_distance(bodies[body])))
        return bodies[self._followed]

    def _publish_skeletons(
        self, prefix: str, pose: NDArray[Any], t: float, doubted: Sequence[int] = ()
    ) -> None:
        try:
            state = ros.make_joint_state(
                pose, t, skeleton=self.skeleton, up=self.up, body=self.body
            )
        except (UnknownJointError, ValueError):
            return
        self.publish(ros.topic(self.body, f"{prefix}joint_states"), JOINTS, state)
        if self.camera is not None:
            view = self._place | {"up": self.up}  # the camera looks along x in ROS's axes
            made = ros.make_skeleton2d(pose, t, camera=self.camera, doubted=doubted, **view)
            self.publish(ros.topic(self.body, f"{prefix}skeleton2d"), SKELETON, made)


def _distance(pose: NDArray[np.float64]) -> float:
    return float(np.nanmedian(np.linalg.norm(pose, axis=1)))
