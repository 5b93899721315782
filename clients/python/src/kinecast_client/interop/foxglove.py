"""A person and their forecast in Foxglove's schemas, as JSON: `SceneUpdate` and `FrameTransforms`.

Positions are in ROS's axes (z up), which is what Foxglove's 3D panel expects. Foxglove finds a
schema by its name; the ones here describe every field that is written. Its reader takes less than
JSON Schema allows: every property has one type, an object has properties, and no array lies in an
array.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from kinecast_client.forecasts import Forecast
from kinecast_client.interop.body import (
    Array,
    Skeleton,
    UnknownJointError,
    find_body,
    to_ros,
)
from kinecast_client.interop.ros import (
    FORECAST_COLOUR,
    LIFETIME_S,
    OBSERVED_COLOUR,
    SHOWN,
    UNSAFE_COLOUR,
)

Message = dict[str, Any]
LINE_LIST = 2
_UPRIGHT = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
_HERE = {"position": {"x": 0.0, "y": 0.0, "z": 0.0}, "orientation": _UPRIGHT}
_PRIMITIVES = ("arrows", "cubes", "spheres", "cylinders", "lines", "triangles", "texts", "models")


def make_observed_scene(
    pose: Array, at_ns: int, *, skeleton: Skeleton, up: str, frame_id: str
) -> Message:
    """Make a `foxglove.SceneUpdate` of what was observed.

    Args:
        pose: metres, as the sensor gives it: [joint, 3]; NaN for a missing joint.
        at_ns: when, nanoseconds since 1970.
        skeleton: what to draw.
        up: the user's.
        frame_id: of the sensor.
    """
    lines = _lines(to_ros(pose, up), skeleton, (*OBSERVED_COLOUR, 1.0), thickness=0.03)
    return _scene([_entity("observed", at_ns, frame_id, lines=[lines])])


def make_forecast_scene(
    forecast: Forecast,
    at_ns: int,
    *,
    skeleton: Skeleton,
    up: str,
    frame_id: str,
    shown: Sequence[int] = SHOWN,
) -> Message:
    """Make a `foxglove.SceneUpdate` of a forecast: fading skeletons, and the radius of the last.

    Args:
        forecast: of one person.
        at_ns: when its newest frame was captured, nanoseconds since 1970.
        skeleton: what to draw.
        up: the user's.
        frame_id: of the sensor.
        shown: which frames to draw, counted from 0.
    """
    colour = FORECAST_COLOUR if forecast.is_usable else UNSAFE_COLOUR
    poses = to_ros(forecast.frames, up)
    fades = [0.9 - 0.7 * k / len(poses) for k in shown]
    lines = [
        _lines(poses[k], skeleton, (*colour, fade)) for k, fade in zip(shown, fades, strict=True)
    ]
    spheres = []
    if forecast.radius is not None and forecast.is_usable:
        pairs = zip(poses[shown[-1]], forecast.radius[shown[-1]].tolist(), strict=True)
        spheres = [_sphere(place, radius, (*colour, 0.12)) for place, radius in pairs]
    said = {"version": str(forecast.version.number), "quality": " ".join(forecast.quality)}
    return _scene(
        [_entity("forecast", at_ns, frame_id, lines=lines, spheres=spheres, metadata=said)]
    )


def make_frame_transforms(
    pose: Array, at_ns: int, *, skeleton: Skeleton, up: str, frame_id: str, body: str
) -> Message:
    """Make `foxglove.FrameTransforms`: from `world` to the sensor, and from there to the body.

    The sensor is put at the origin of `world`, because nothing else is known of it. A body whose
    hips or shoulders are missing has no transform.
    """
    transforms = [_transform("world", frame_id, np.zeros(3), _UPRIGHT, at_ns)]
    try:
        frame = find_body(to_ros(pose, up), skeleton)
    except (UnknownJointError, ValueError):
        return {"transforms": transforms}
    turn = dict(zip("xyzw", frame.quaternion, strict=True))
    return {
        "transforms": [
            *transforms,
            _transform(frame_id, f"body_{body}", frame.origin, turn, at_ns),
        ]
    }


def make_time(at_ns: int) -> Message:
    """Give nanoseconds as seconds and the rest."""
    return {"sec": at_ns // 10**9, "nsec": at_ns % 10**9}


def _scene(entities: list[Message]) -> Message:
    return {"deletions": [], "entities": entities}


def _entity(
    name: str,
    at_ns: int,
    frame_id: str,
    *,
    metadata: dict[str, str] | None = None,
    **primitives: list[Message],
) -> Message:
    return {
        "timestamp": make_time(at_ns),
        "frame_id": frame_id,
        "id": name,
        "lifetime": make_time(round(LIFETIME_S * 1e9)),
        "frame_locked": True,
        "metadata": [{"key": k, "value": v} for k, v in (metadata or {}).items()],
        **{kind: primitives.get(kind, []) for kind in _PRIMITIVES},
    }


def _lines(
    pose: Array,
    skeleton: Skeleton,
    colour: tuple[float, float, float, float],
    *,
    thickness: float = 0.02,
) -> Message:
    whole = [bone for bone in skeleton.bones if np.all(np.isfinite(pose[list(bone)]))]
    return {
        "type": LINE_LIST,
        "pose": _HERE,
        "thickness": thickness,
        "scale_invariant": False,
        "points": [_xyz(pose[joint]) for bone in whole for joint in bone],
        "color": dict(zip("rgba", colour, strict=True)),
        "colors": [],
        "indices": [],
    }


def _sphere(place: Array, radius: float, colour: tuple[float, float, float, float]) -> Message:
    return {
        "pose": {"position": _xyz(place), "orientation": _UPRIGHT},
        "size": {"x": 2 * radius, "y": 2 * radius, "z": 2 * radius},
        "color": dict(zip("rgba", colour, strict=True)),
    }


def _transform(parent: str, child: str, place: Array, turn: Message, at_ns: int) -> Message:
    return {
        "timestamp": make_time(at_ns),
        "parent_frame_id": parent,
        "child_frame_id": child,
        "translation": _xyz(place),
        "rotation": turn,
    }


def _xyz(place: Array) -> Message:
    x, y, z = (float(value) for value in place)
    return {"x": x, "y": y, "z": z}


def describe_object(title: str, **properties: Message) -> Message:
    """Give the schema of an object."""
    return {"title": title, "type": "object", "properties": properties}


def describe_list(items: Message) -> Message:
    """Give the schema of a list; `items` must not be a list again."""
    return {"type": "array", "items": items}


NUMBER, TEXT, SWITCH, WHOLE = ({"type": t} for t in ("number", "string", "boolean", "integer"))
_TIME = describe_object("time", sec=WHOLE, nsec=WHOLE)
_DURATION = describe_object("duration", sec=WHOLE, nsec=WHOLE)
_VECTOR = describe_object("foxglove.Vector3", **dict.fromkeys("xyz", NUMBER))
POINT = describe_object("foxglove.Point3", **dict.fromkeys("xyz", NUMBER))
_QUATERNION = describe_object("foxglove.Quaternion", **dict.fromkeys("xyzw", NUMBER))
_POSE = describe_object("foxglove.Pose", position=_VECTOR, orientation=_QUATERNION)
_COLOUR = describe_object("foxglove.Color", **dict.fromkeys("rgba", NUMBER))
_SPHERE = describe_object("foxglove.SpherePrimitive", pose=_POSE, size=_VECTOR, color=_COLOUR)
_LINE = describe_object(
    "foxglove.LinePrimitive",
    type=WHOLE,
    pose=_POSE,
    thickness=NUMBER,
    scale_invariant=SWITCH,
    points=describe_list(POINT),
    color=_COLOUR,
    colors=describe_list(_COLOUR),
    indices=describe_list(WHOLE),
)
_ENTITY = describe_object(
    "foxglove.SceneEntity",
    timestamp=_TIME,
    frame_id=TEXT,
    id=TEXT,
    lifetime=_DURATION,
    frame_locked=SWITCH,
    metadata=describe_list(describe_object("foxglove.KeyValuePair", key=TEXT, value=TEXT)),
    **{kind: describe_list(describe_object(kind)) for kind in _PRIMITIVES}
    | {"spheres": describe_list(_SPHERE), "lines": describe_list(_LINE)},
)
_DELETION = describe_object("foxglove.SceneEntityDeletion", timestamp=_TIME, type=WHOLE, id=TEXT)
SCENE_UPDATE = describe_object(
    "foxglove.SceneUpdate", deletions=describe_list(_DELETION), entities=describe_list(_ENTITY)
)
"""JSON Schema of what is written as `foxglove.SceneUpdate`."""
FRAME_TRANSFORMS = describe_object(
    "foxglove.FrameTransforms",
    transforms=describe_list(
        describe_object(
            "foxglove.FrameTransform",
            timestamp=_TIME,
            parent_frame_id=TEXT,
            child_frame_id=TEXT,
            translation=_VECTOR,
            rotation=_QUATERNION,
        )
    ),
)
"""JSON Schema of what is written as `foxglove.FrameTransforms`."""
