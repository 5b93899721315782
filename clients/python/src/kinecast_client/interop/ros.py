"""A forecast as ROS 2 messages: plain dicts with the fields of the real definitions.

A dict has only fields that are set; `rosidl_runtime_py.set_message_fields` makes it a message.
Positions are turned into ROS's axes (REP 103) by the user's `up`; `frame_id` names a frame that
lies so at the sensor. Where TF knows the sensor's own frame, an optical one for example, give that,
and `up="z"`, which turns nothing. Bodies, topics and frames are named by REP 155. That REP does not
speak of forecasts: ours lie below the body, in `forecast`.

Time. A marker and a trajectory are stamped with the capture time of the newest frame that was used,
as anything measured is. A skeleton or joint state of the future is stamped with the time that it is
for. Frames of the future are never sent to TF, which has no place for them.
"""

import hashlib
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from kinecast_client.forecasts import Forecast
from kinecast_client.interop.body import Array, Skeleton, find_body, to_ros
from kinecast_client.interop.human import find_angles

Message = dict[str, Any]

ADD, DELETE = 0, 2
SPHERE, LINE_LIST = 2, 5
SHOWN = (2, 5, 8, 11, 14)
"""Which frames of a forecast are drawn: 0.1, 0.2, … 0.5 s ahead."""
LIFETIME_S = 0.2
"""Markers vanish after this without a newer forecast."""
OBSERVED_COLOUR = (0.10, 0.10, 0.12)
FORECAST_COLOUR = (0.90, 0.40, 0.05)
UNSAFE_COLOUR = (0.55, 0.55, 0.55)

OPENPOSE = (
    *(None, "neck", "r_shoulder", "r_elbow", "r_wrist", "l_shoulder", "l_elbow", "l_wrist"),
    *("r_hip", "r_knee", "r_ankle", "l_hip", "l_knee", "l_ankle", None, None, None, None),
)
"""The 18 points of `hri_msgs/Skeleton2D` as joints of REP 155; nose, eyes and ears are unknown."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera at the sensor, looking along its x axis: `sensor_msgs/CameraInfo`, in short.

    Attributes:
        fx, fy, cx, cy: pixels.
        width, height: pixels.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int


def name_body(user: str) -> str:
    """Give a user's id as a body's: letters, digits and `_`, not beginning with a digit.

    That is what a ROS 2 topic allows. An id that has to change ends in a few letters of its hash,
    so that no two users get the same.
    """
    if re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", user):
        return user
    plain = re.sub(r"[^A-Za-z0-9_]", "_", user)
    return f"b_{plain}_{hashlib.sha256(user.encode()).hexdigest()[:8]}"


def topic(body: str, name: str) -> str:
    """Name a topic of a body, such as `joint_states` or `forecast/joint_states`."""
    return f"/humans/bodies/{body}/{name}"


def make_header(t: float, frame_id: str) -> Message:
    """Make a `std_msgs/Header`; `t` in seconds of ROS time."""
    return {"stamp": make_time(t), "frame_id": frame_id}


def make_time(t: float) -> Message:
    """Make a `builtin_interfaces/Time` or `Duration`, to the nanosecond that a float64 can hold."""
    nanoseconds = round(t * 1e9)
    return {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9}


def make_ids(bodies: Iterable[str], t: float) -> Message:
    """Make the `hri_msgs/IdsList` of `/humans/bodies/tracked`."""
    return {"header": make_header(t, ""), "ids": list(bodies)}


def make_forecast_markers(
    forecast: Forecast,
    *,
    skeleton: Skeleton,
    up: str,
    frame_id: str,
    body: str,
    shown: Sequence[int] = SHOWN,
) -> Message:
    """Make a `visualization_msgs/MarkerArray` of a forecast: fading skeletons and the radius.

    Namespaces are `<body>/forecast`, one id per frame, and `<body>/radius`, one id per joint of the
    last frame. A forecast that is `unsafe` is grey and has no radius.

    Args:
        forecast: of one person; its times are seconds of ROS time.
        skeleton: the joints of its frames, and the bones to draw.
        up: the user's.
        frame_id: of the sensor.
        body: as `name_body` gives it.
        shown: which frames to draw, counted from 0.
    """
    header = make_header(forecast.t_observed, frame_id)
    colour = FORECAST_COLOUR if forecast.is_usable else UNSAFE_COLOUR
    poses = to_ros(forecast.frames, up)
    markers = [
        _lines(header, f"{body}/forecast", k, poses[k], skeleton, (*colour, _fade(k, len(poses))))
        for k in shown
    ]
    if forecast.radius is not None and forecast.is_usable:
        last = shown[-1]
        pairs = zip(poses[last], forecast.radius[last].tolist(), strict=True)
        markers += [
            _ball(header, f"{body}/radius", joint, place, radius, (*colour, 0.12))
            for joint, (place, radius) in enumerate(pairs)
        ]
    return {"markers": markers}


def make_pose_markers(
    pose: Array, t: float, *, skeleton: Skeleton, up: str, frame_id: str, body: str
) -> Message:
    """Make a `visualization_msgs/MarkerArray` of what was observed, in `<body>/observed`."""
    header = make_header(t, frame_id)
    colour = (*OBSERVED_COLOUR, 1.0)
    return {
        "markers": [
            _lines(header, f"{body}/observed", 0, to_ros(pose, up), skeleton, colour, width=0.03)
        ]
    }


def make_deletion(
    body: str, t: float, frame_id: str, *, joints: int, shown: Sequence[int] = SHOWN
) -> Message:
    """Make a `visualization_msgs/MarkerArray` that takes a person's markers away, and no others."""
    names = [
        (f"{body}/observed", 0),
        *((f"{body}/forecast", k) for k in shown),
        *((f"{body}/radius", joint) for joint in range(joints)),
    ]
    header = make_header(t, frame_id)
    return {"markers": [{"header": header, "ns": ns, "id": i, "action": DELETE} for ns, i in names]}


def make_trajectory(forecast: Forecast, *, skeleton: Skeleton, up: str, frame_id: str) -> Message:
    """Make a `trajectory_msgs/MultiDOFJointTrajectory`: every joint at every time, for planners.

    Rotations are the identity, because a joint is a point.
    """
    points = [
        {
            "transforms": [{"translation": _xyz(place), "rotation": _NO_TURN} for place in pose],
            "time_from_start": make_time(float(t) - forecast.t_observed),
        }
        for pose, t in zip(to_ros(forecast.frames, up), forecast.t, strict=True)
    ]
    return {
        "header": make_header(forecast.t_observed, frame_id),
        "joint_names": list(skeleton.joints),
        "points": points,
    }


def make_joint_state(pose: Array, t: float, *, skeleton: Skeleton, up: str, body: str) -> Message:
    """Make the `sensor_msgs/JointState` of a pose, observed or forecast, by REP 155's human.

    Raises:
        UnknownJointError, ValueError: hips or shoulders are missing.
    """
    angles = find_angles(to_ros(pose, up), skeleton)
    return {
        "header": make_header(t, ""),  # joints have no frame
        "name": [f"{joint}_{body}" for joint in angles],
        "position": list(angles.values()),
    }


def make_skeleton2d(
    pose: Array,
    t: float,
    *,
    skeleton: Skeleton,
    up: str,
    frame_id: str,
    camera: Camera,
    doubted: Iterable[int] = (),
) -> Message:
    """Make the `hri_msgs/Skeleton2D` of a pose, as the camera would see it.

    A point that is not known, lies behind the camera or outside of its picture has x, y and
    confidence 0; so have `doubted` joints, such as a forecast's `filled`.
    """
    points = _name_points(to_ros(pose, up), skeleton, set(doubted))
    return {
        "header": make_header(t, frame_id),
        "skeleton": [_project(points.get(name), camera) for name in OPENPOSE],
    }


def make_transforms(
    pose: Array,
    t: float,
    *,
    skeleton: Skeleton,
    up: str,
    frame_id: str,
    body: str,
    joints: bool = False,
) -> list[Message]:
    """Make `geometry_msgs/TransformStamped` of what was observed: `body_<id>`, and below it joints.

    Args:
        pose: metres, as the sensor gives it: [joint, 3].
        t: when it was captured, seconds of ROS time.
        skeleton: the joints.
        up: the user's.
        frame_id: of the sensor, the parent of the body.
        body: as `name_body` gives it.
        joints: whether to add the frames of joints. Leave them out where a
            `robot_state_publisher` makes them from the joint state.

    Raises:
        UnknownJointError, ValueError: hips or shoulders are missing.
    """
    points = to_ros(pose, up)
    frame = find_body(points, skeleton)
    x, y, z, w = frame.quaternion
    turn = {"x": x, "y": y, "z": z, "w": w}
    made = [_transform(make_header(t, frame_id), f"body_{body}", frame.origin, turn)]
    if joints:
        local = frame.localise(points)
        header = make_header(t, f"body_{body}")
        made += [
            _transform(header, f"{role}_{body}", local[place], _NO_TURN)
            for role, place in skeleton.roles.items()
            if np.all(np.isfinite(local[place]))
        ]
    return made


_NO_TURN = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}


def _transform(header: Message, child: str, place: Array, turn: Message) -> Message:
    return {
        "header": header,
        "child_frame_id": child,
        "transform": {"translation": _xyz(place), "rotation": turn},
    }


def _lines(
    header: Message,
    ns: str,
    number: int,
    pose: Array,
    skeleton: Skeleton,
    colour: tuple[float, float, float, float],
    *,
    width: float = 0.02,
) -> Message:
    ends = [pose[joint] for bone in skeleton.bones for joint in bone if _is_whole(pose, bone)]
    return {
        **_marker(header, ns, number, LINE_LIST, colour),
        "pose": {"orientation": _NO_TURN},
        "scale": {"x": width, "y": 0.0, "z": 0.0},
        "points": [_xyz(end) for end in ends],
    }


def _ball(
    header: Message,
    ns: str,
    number: int,
    place: Array,
    radius: float,
    colour: tuple[float, float, float, float],
) -> Message:
    return {
        **_marker(header, ns, number, SPHERE, colour),
        "pose": {"position": _xyz(place), "orientation": _NO_TURN},
        "scale": {"x": 2 * radius, "y": 2 * radius, "z": 2 * radius},
    }


def _marker(
    header: Message, ns: str, number: int, kind: int, colour: tuple[float, float, float, float]
) -> Message:
    return {
        "header": header,
        "ns": ns,
        "id": number,
        "type": kind,
        "action": ADD,
        "color": dict(zip("rgba", colour, strict=True)),
        "lifetime": make_time(LIFETIME_S),
    }


def _fade(k: int, frames: int) -> float:
    return round(0.9 - 0.7 * k / frames, 3)


def _is_whole(pose: Array, bone: tuple[int, int]) -> bool:
    return bool(np.all(np.isfinite(pose[list(bone)])))


def _xyz(place: Array) -> Message:
    x, y, z = (float(value) for value in place)
    return {"x": x, "y": y, "z": z}


def _name_points(pose: Array, skeleton: Skeleton, doubted: set[int]) -> dict[str | None, Array]:
    points: dict[str | None, Array] = {
        role: pose[place] for role, place in skeleton.roles.items() if place not in doubted
    }
    if "l_shoulder" in points and "r_shoulder" in points:
        points["neck"] = (points["l_shoulder"] + points["r_shoulder"]) / 2
    return points


def _project(place: Array | None, camera: Camera) -> Message:
    """Give a normalised point; x right and y down, from the upper left corner."""
    if place is None or not place[0] > 0 or not math.isfinite(float(place.sum())):
        return {"x": 0.0, "y": 0.0, "c": 0.0}
    x = (camera.cx - camera.fx * place[1] / place[0]) / camera.width
    y = (camera.cy - camera.fy * place[2] / place[0]) / camera.height
    if not (0 <= x <= 1 and 0 <= y <= 1):
        return {"x": 0.0, "y": 0.0, "c": 0.0}
    return {"x": float(x), "y": float(y), "c": 1.0}
