"""Fields of ROS 2's messages, read from their definitions: what a conversion may set.

From ros2/common_interfaces, ros2/rcl_interfaces and ros2/geometry2 as of Humble, Jazzy and Kilted,
which agree on these, and from ros4hri/hri_msgs 2. `T[]` is a sequence, `T[n]` has n elements.
"""

FIELDS: dict[str, dict[str, str]] = {
    "builtin_interfaces/Time": {"sec": "int32", "nanosec": "uint32"},
    "builtin_interfaces/Duration": {"sec": "int32", "nanosec": "uint32"},
    "std_msgs/Header": {"stamp": "builtin_interfaces/Time", "frame_id": "string"},
    "std_msgs/ColorRGBA": dict.fromkeys("rgba", "float32"),
    "geometry_msgs/Point": dict.fromkeys("xyz", "float64"),
    "geometry_msgs/Vector3": dict.fromkeys("xyz", "float64"),
    "geometry_msgs/Quaternion": dict.fromkeys("xyzw", "float64"),
    "geometry_msgs/Pose": {
        "position": "geometry_msgs/Point",
        "orientation": "geometry_msgs/Quaternion",
    },
    "geometry_msgs/Transform": {
        "translation": "geometry_msgs/Vector3",
        "rotation": "geometry_msgs/Quaternion",
    },
    "geometry_msgs/TransformStamped": {
        "header": "std_msgs/Header",
        "child_frame_id": "string",
        "transform": "geometry_msgs/Transform",
    },
    "sensor_msgs/JointState": {
        "header": "std_msgs/Header",
        "name": "string[]",
        "position": "float64[]",
        "velocity": "float64[]",
        "effort": "float64[]",
    },
    "trajectory_msgs/MultiDOFJointTrajectory": {
        "header": "std_msgs/Header",
        "joint_names": "string[]",
        "points": "trajectory_msgs/MultiDOFJointTrajectoryPoint[]",
    },
    "trajectory_msgs/MultiDOFJointTrajectoryPoint": {
        "transforms": "geometry_msgs/Transform[]",
        "velocities": "geometry_msgs/Twist[]",
        "accelerations": "geometry_msgs/Twist[]",
        "time_from_start": "builtin_interfaces/Duration",
    },
    "visualization_msgs/MarkerArray": {"markers": "visualization_msgs/Marker[]"},
    "visualization_msgs/Marker": {
        "header": "std_msgs/Header",
        "ns": "string",
        "id": "int32",
        "type": "int32",
        "action": "int32",
        "pose": "geometry_msgs/Pose",
        "scale": "geometry_msgs/Vector3",
        "color": "std_msgs/ColorRGBA",
        "lifetime": "builtin_interfaces/Duration",
        "frame_locked": "bool",
        "points": "geometry_msgs/Point[]",
        "colors": "std_msgs/ColorRGBA[]",
        "texture_resource": "string",
        "texture": "sensor_msgs/CompressedImage",
        "uv_coordinates": "visualization_msgs/UVCoordinate[]",
        "text": "string",
        "mesh_resource": "string",
        "mesh_file": "visualization_msgs/MeshFile",
        "mesh_use_embedded_materials": "bool",
    },
    "hri_msgs/IdsList": {"header": "std_msgs/Header", "ids": "string[]"},
    "hri_msgs/Skeleton2D": {
        "header": "std_msgs/Header",
        "skeleton": "hri_msgs/NormalizedPointOfInterest2D[18]",
    },
    "hri_msgs/NormalizedPointOfInterest2D": dict.fromkeys("xyc", "float32"),
}

_RANGES = {"int32": (-(2**31), 2**31 - 1), "uint32": (0, 2**32 - 1)}


def check(value: object, kind: str) -> None:
    """Fail where a value is not what a message of this kind can hold."""
    if kind.endswith("]"):
        inner, _, count = kind[:-1].partition("[")
        assert isinstance(value, list), kind
        assert not count or len(value) == int(count), kind
        for one in value:
            check(one, inner)
    elif kind in FIELDS:
        assert isinstance(value, dict), kind
        assert set(value) <= set(FIELDS[kind]), f"{kind} has no {set(value) - set(FIELDS[kind])}"
        for name, one in value.items():
            check(one, FIELDS[kind][name])
    elif kind in _RANGES:
        assert type(value) is int, kind
        assert _RANGES[kind][0] <= value <= _RANGES[kind][1], kind
    else:
        expected = {"string": str, "bool": bool, "float32": float, "float64": float}[kind]
        assert type(value) is expected, f"{kind}: {value!r}"
