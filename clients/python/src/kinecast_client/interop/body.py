"""Which joint is which, whatever the sensor calls it, and the frame of a body in ROS's axes."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

_TO_ROS: dict[str, tuple[tuple[int, int, int], tuple[float, float, float]]] = {
    "y": ((2, 0, 1), (1.0, 1.0, 1.0)),
    "-y": ((2, 0, 1), (1.0, -1.0, -1.0)),
    "z": ((0, 1, 2), (1.0, 1.0, 1.0)),
}
"""By the axis that points up: which coordinate becomes forward, left and up, and its sign."""

_SIDES = {"l": ("left", "l"), "r": ("right", "r")}
_PARTS = {
    "shoulder": ("shoulder",),
    "elbow": ("elbow",),
    "wrist": ("wrist",),
    "hip": ("hip",),
    "knee": ("knee",),
    "ankle": ("ankle", "foot"),
}
_HEADS = ("head", "nose", "necknose")


class UnknownJointError(KeyError):
    """A skeleton lacks a joint that a conversion needs."""


@dataclass(frozen=True)
class Skeleton:
    """Names and bones of a sensor's joints, as `GET /v1/skeletons` gives them.

    Attributes:
        joints: names, in the order of the poses.
        bones: pairs of joints to draw.
    """

    joints: tuple[str, ...]
    bones: tuple[tuple[int, int], ...] = field(repr=False)

    @cached_property
    def roles(self) -> dict[str, int]:
        """Give the joints that have a name in REP 155, such as `l_elbow`, `r_hip` or `head`."""
        plain = [joint.lower().replace("_", "").replace("/", "") for joint in self.joints]
        wanted = {"head": _HEADS} | {
            f"{side}_{part}": [
                spelt for name in names for word in words for spelt in (word + name, name + word)
            ]
            for side, words in _SIDES.items()
            for part, names in _PARTS.items()
        }
        found = {role: _find(plain, names) for role, names in wanted.items()}
        return {role: place for role, place in found.items() if place is not None}

    def role(self, name: str) -> int:
        """Give the index of a joint by its name in REP 155.

        Raises:
            UnknownJointError: this skeleton has none.
        """
        try:
            return self.roles[name]
        except KeyError:
            raise UnknownJointError(name) from None


KINECT_V1 = Skeleton(
    joints=(
        *("head", "shoulder_center", "spine", "hip_center"),
        *("left_shoulder", "left_elbow", "left_wrist", "left_hand"),
        *("right_shoulder", "right_elbow", "right_wrist", "right_hand"),
        *("left_hip", "left_knee", "left_ankle", "left_foot"),
        *("right_hip", "right_knee", "right_ankle", "right_foot"),
    ),
    bones=(
        *((1, 0), (2, 1), (3, 2)),
        *((1, 4), (4, 5), (5, 6), (6, 7), (1, 8), (8, 9), (9, 10), (10, 11)),
        *((3, 12), (12, 13), (13, 14), (14, 15), (3, 16), (16, 17), (17, 18), (18, 19)),
    ),
)
"""The service's own skeleton, in the order of UTD-MHAD."""


@dataclass(frozen=True, eq=False)
class BodyFrame:
    """The frame `body_<id>` of REP 155: between the hips, x forward, y left, z towards the head.

    Attributes:
        origin: metres, in the sensor's frame by REP 103: [3].
        axes: the body's x, y and z there, one per column: [3, 3].
    """

    origin: Array
    axes: Array

    @property
    def quaternion(self) -> tuple[float, float, float, float]:
        """Give the rotation as x, y, z, w."""
        return to_quaternion(self.axes)

    def localise(self, points: Array) -> Array:
        """Give points of the sensor's frame in the body's: [..., 3]."""
        return np.asarray((points - self.origin) @ self.axes)


def to_ros(points: npt.ArrayLike, up: str) -> Array:
    """Turn points into ROS's axes (REP 103): x forward, y left, z up, metres; the origin stays.

    Args:
        points: as the sensor gives them, metres: [..., 3].
        up: the user's: `y` (Kinect: x to the sensor's left, z away from it), `-y` (optical frames:
            x right, z away) or `z` (ROS already: nothing is turned).

    Raises:
        ValueError: another `up`.
    """
    if up not in _TO_ROS:
        raise ValueError(f"up must be y, -y or z, got {up!r}")
    order, signs = _TO_ROS[up]
    turned = np.asarray(points, dtype=np.float64)[..., order]
    return np.asarray(turned * np.array(signs), dtype=np.float64)


def find_body(pose: Array, skeleton: Skeleton) -> BodyFrame:
    """Find the body's frame in a pose in ROS's axes: [joint, 3].

    Left is from the right hip to the left one, up is towards the middle of the shoulders.

    Raises:
        UnknownJointError: hips or shoulders are not in the skeleton.
        ValueError: they are missing in the pose, or in one line.
    """
    l_hip, r_hip, l_shoulder, r_shoulder = (
        pose[skeleton.role(name)] for name in ("l_hip", "r_hip", "l_shoulder", "r_shoulder")
    )
    origin = (l_hip + r_hip) / 2
    rise, left = (l_shoulder + r_shoulder) / 2 - origin, l_hip - r_hip
    forward = np.cross(left, rise)
    up = np.cross(forward, left)
    axes = np.stack([forward, left, up], axis=1)
    sizes = np.linalg.norm(axes, axis=0)
    if not np.all(sizes > 1e-9):
        raise ValueError("hips and shoulders do not show where the body is")
    return BodyFrame(origin, axes / sizes)


def to_quaternion(axes: Array) -> tuple[float, float, float, float]:
    """Give a rotation matrix as x, y, z, w with w not negative.

    By the eigenvector of the largest eigenvalue (Bar-Itzhack 2000), which has no special cases.
    """
    m = axes
    symmetric = np.array(
        [
            [m[0, 0] - m[1, 1] - m[2, 2], 0, 0, 0],
            [m[1, 0] + m[0, 1], m[1, 1] - m[0, 0] - m[2, 2], 0, 0],
            [m[2, 0] + m[0, 2], m[2, 1] + m[1, 2], m[2, 2] - m[0, 0] - m[1, 1], 0],
            [m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], np.trace(m)],
        ]
    )
    x, y, z, w = np.linalg.eigh(symmetric)[1][:, -1].tolist()
    return (x, y, z, w) if w >= 0 else (-x, -y, -z, -w)


def _find(plain: Sequence[str], names: Sequence[str]) -> int | None:
    return next((plain.index(name) for name in names if name in plain), None)
