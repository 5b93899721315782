"""Angles of a human's joints by REP 155, for `/humans/bodies/<id>/joint_states`.

The chain and its axes are those of the URDF that REP 155 recommends (`human_description`):

- an arm turns about −z, +x and +z on the left, +z, −x and −z on the right, then bends at the
  elbow about −y;
- a leg turns about −z, ±x and −y, and the knee about −y, where a bent knee is negative;
- the head rolls about x, turns about z and nods about −y on the torso.

The body's frame already follows the torso, so `waist` is 0. A head is one point: it shows no turn,
so `y_head` is 0. The angles make the URDF's limbs point where the observed ones do; how long they
are is up to the URDF.
"""

from math import acos, asin, atan2

import numpy as np

from kinecast_client.interop.body import Array, Skeleton, find_body

JOINTS = (
    *("waist", "r_head", "y_head", "p_head"),
    *(f"{side}_{name}" for side in "lr" for name in ("y_shoulder", "p_shoulder", "r_shoulder")),
    *(f"{side}_elbow" for side in "lr"),
    *(f"{side}_{name}" for side in "lr" for name in ("y_hip", "p_hip", "r_hip")),
    *(f"{side}_knee" for side in "lr"),
)
"""Every joint that moves, without the suffix `_<id>`."""

_STRAIGHT = 0.03
"""Below this sine of the bend a knee does not show which way its leg is turned."""


def find_angles(pose: Array, skeleton: Skeleton) -> dict[str, float]:
    """Give the angle of every joint in radians, 0 where a limb was not observed.

    Args:
        pose: in ROS's axes, metres: [joint, 3]; NaN for a missing joint.
        skeleton: what the joints are called.

    Raises:
        UnknownJointError: the skeleton has no hips or no shoulders.
        ValueError: they are missing in the pose.
    """
    local = find_body(pose, skeleton).localise(pose)
    points = {role: local[place] for role, place in skeleton.roles.items()}
    angles = dict.fromkeys(JOINTS, 0.0)
    angles.update(_nod(points))
    for side, sign in (("l", 1.0), ("r", -1.0)):
        upper, fore = _limb(points, side, ("shoulder", "elbow", "wrist"))
        if upper is not None and fore is not None:
            angles.update(_bend_arm(side, sign, upper, fore))
        thigh, shank = _limb(points, side, ("hip", "knee", "ankle"))
        if thigh is not None and shank is not None:
            angles.update(_bend_leg(side, sign, thigh, shank))
    return angles


def _nod(points: dict[str, Array]) -> dict[str, float]:
    """Tilt the head towards where it is above the middle of the shoulders."""
    way = _unit(points.get("head", np.full(3, np.nan)) - _middle(points))
    if way is None:
        return {}
    pitch = -asin(float(np.clip(way[0], -1.0, 1.0)))
    return {"r_head": atan2(-float(way[1]), float(way[2])), "p_head": pitch}


def _bend_arm(side: str, sign: float, upper: Array, fore: Array) -> dict[str, float]:
    """Turn the shoulder until the upper arm points as observed, then the elbow."""
    pitch = acos(float(np.clip(-upper[2], -1.0, 1.0)))
    yaw = atan2(float(upper[0]), float(sign * upper[1]))
    inside = _turn_x(-sign * pitch) @ _turn_z(sign * yaw) @ fore
    bend = acos(float(np.clip(-inside[2], -1.0, 1.0)))
    roll = sign * atan2(float(inside[1]), float(inside[0])) if bend > 1e-6 else 0.0
    return {
        f"{side}_y_shoulder": yaw,
        f"{side}_p_shoulder": pitch,
        f"{side}_r_shoulder": roll,
        f"{side}_elbow": bend,
    }


def _bend_leg(side: str, sign: float, thigh: Array, shank: Array) -> dict[str, float]:
    """Turn the hip until thigh and shank lie in the plane in which the knee bends."""
    across = np.cross(shank, thigh)
    size = float(np.linalg.norm(across))
    if size < _STRAIGHT:
        across = np.array([0.0, 1.0, 0.0]) - thigh[1] * thigh
        size = float(np.linalg.norm(across)) or 1.0
    across = across / size * (1.0 if across[1] >= 0 else -1.0)
    pitch = sign * asin(float(np.clip(across[2], -1.0, 1.0)))
    yaw = atan2(float(across[0]), float(across[1]))
    back = _turn_x(-sign * pitch) @ _turn_z(yaw)
    upper, lower = back @ thigh, back @ shank
    swing = atan2(float(upper[0]), float(-upper[2]))
    knee = atan2(float(lower[0]), float(-lower[2])) - swing
    return {
        f"{side}_y_hip": yaw,
        f"{side}_p_hip": pitch,
        f"{side}_r_hip": swing,
        f"{side}_knee": (knee + np.pi) % (2 * np.pi) - np.pi,
    }


def _limb(
    points: dict[str, Array], side: str, parts: tuple[str, str, str]
) -> tuple[Array | None, Array | None]:
    """Give the directions of a limb's two bones."""
    missing = np.full(3, np.nan)
    a, b, c = (points.get(f"{side}_{part}", missing) for part in parts)
    return _unit(b - a), _unit(c - b)


def _middle(points: dict[str, Array]) -> Array:
    return np.asarray((points["l_shoulder"] + points["r_shoulder"]) / 2)


def _unit(way: Array) -> Array | None:
    size = float(np.linalg.norm(way))
    return np.asarray(way / size) if size > 1e-9 else None  # NaN is not greater


def _turn_x(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def _turn_z(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
