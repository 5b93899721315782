"""Skeletons: joint names, kinematic trees, mirror pairs, and the maps onto the net's skeleton.

The net knows one skeleton, `kinect_v1` in the joint order of UTD-MHAD. Every other format is
brought onto it by one linear map, so its centre joints are estimated rather than measured where the
format lacks them. Names and trees are those of the formats' own documentation. The constants of the
estimated joints were fitted on the recordings of UTD-MHAD's odd subjects. Free of torch, so that
the service's edge can read it.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int

Forecast = Literal["net", "carried"]
Bones = tuple[tuple[int, int], ...]

HEAD, SHOULDER_CENTER, SPINE, HIP_CENTER = 0, 1, 2, 3
LEFT_SHOULDER, LEFT_ELBOW, LEFT_WRIST, LEFT_HAND = 4, 5, 6, 7
RIGHT_SHOULDER, RIGHT_ELBOW, RIGHT_WRIST, RIGHT_HAND = 8, 9, 10, 11
LEFT_HIP, LEFT_KNEE, LEFT_ANKLE, LEFT_FOOT = 12, 13, 14, 15
RIGHT_HIP, RIGHT_KNEE, RIGHT_ANKLE, RIGHT_FOOT = 16, 17, 18, 19
NET_JOINTS = 20

HAND_REACH = 0.33
"""Hand = wrist + this share of elbow -> wrist (median error 25 mm on Kinect v1 frames)."""
FOOT_REACH = 0.15
"""Foot = ankle + this share of knee -> ankle (least squares; median error 56 mm, as the map is
linear and cannot know where the toes point)."""

_Y_UP_FROM: dict[str, tuple[tuple[int, int, int], tuple[float, float, float]]] = {
    "y": ((0, 1, 2), (1.0, 1.0, 1.0)),
    "-y": ((0, 1, 2), (-1.0, -1.0, 1.0)),
    "z": ((1, 2, 0), (1.0, 1.0, 1.0)),
}
"""For each up axis: which coordinate becomes x, y, z, and its sign."""


@dataclass(frozen=True, eq=False)
class Skeleton:
    """One skeleton format and how it meets the net's.

    Attributes:
        name: the name on the wire.
        joints: joint names in the order of the format.
        parents: parent of each joint, -1 for the root; empty for formats that are graphs.
        bones: pairs of joints to draw; (parent, child) where there is a tree.
        root_relative: whether the sensor has no global position (poses centred on the hips).
        mirror: index of each joint's partner on the other side, itself for the middle ones.
        to_net: [20, J] float64; `to_net @ pose` is the pose in the net's skeleton. Rows sum to 1,
            so it commutes with translation, and being linear with rotation and scale as well.
        carry: [J] for each joint the net joint whose displacement it takes.
        forecast: per joint "net" where exactly that joint is one of the net's, else "carried".
    """

    name: str
    joints: tuple[str, ...]
    parents: tuple[int, ...]
    bones: Bones
    root_relative: bool
    mirror: tuple[int, ...]
    to_net: Float[np.ndarray, "20 joint"] = field(repr=False)
    carry: Int[np.ndarray, " joint"] = field(repr=False)
    forecast: tuple[Forecast, ...] = field(repr=False)

    @cached_property
    def is_net(self) -> bool:
        """Whether this is the net's own skeleton, joint by joint."""
        return np.array_equal(self.to_net, np.eye(NET_JOINTS, len(self.joints)))

    @property
    def layout_sha256(self) -> str:
        """Hex SHA-256 of the joint names, one per line: the `layout` of a stream."""
        return hashlib.sha256("\n".join(self.joints).encode()).hexdigest()


def to_y_up(poses: Float[np.ndarray, "*any 3"], up: str) -> Float[np.ndarray, "*any 3"]:
    """Rotate points or vectors from a right-handed frame with `up` into one with y up.

    Args:
        poses: coordinates in the frame of the input; any leading axes.
        up: "y", "-y" or "z".

    Raises:
        ValueError: for another `up`.
    """
    axes, signs = _find_rotation(up)
    return np.asarray(poses[..., axes] * np.asarray(signs, dtype=poses.dtype))


def from_y_up(vectors: Float[np.ndarray, "*any 3"], up: str) -> Float[np.ndarray, "*any 3"]:
    """Rotate points or vectors with y up back into the frame with `up`: undoes `to_y_up`."""
    axes, signs = _find_rotation(up)
    turned = vectors * np.asarray(signs, dtype=vectors.dtype)
    return np.asarray(turned[..., np.argsort(axes)])


def topological_levels(parents: Sequence[int]) -> tuple[tuple[int, ...], ...]:
    """Group the joints of a tree by depth, the root first.

    Raises:
        ValueError: if `parents` is not one tree (no root, several, or a cycle).
    """
    levels = [tuple(j for j, parent in enumerate(parents) if parent == -1)]
    while levels[-1]:
        above = set(levels[-1])
        levels.append(tuple(j for j, parent in enumerate(parents) if parent in above))
    levels.pop()
    if sum(map(len, levels)) != len(parents) or not levels or len(levels[0]) != 1:
        raise ValueError(f"parents are not one tree: {tuple(parents)}")
    return tuple(levels)


def _find_rotation(up: str) -> tuple[list[int], tuple[float, float, float]]:
    if up not in _Y_UP_FROM:
        raise ValueError(f"up must be one of {', '.join(_Y_UP_FROM)}; got {up!r}")
    axes, signs = _Y_UP_FROM[up]
    return list(axes), signs


def _other_side(name: str) -> str:
    """Give the name of the joint on the other side, in any of the formats' spellings."""
    for left, right in (("left", "right"), ("Left", "Right"), ("LEFT", "RIGHT")):
        if left in name:
            return name.replace(left, right)
        if right in name:
            return name.replace(right, left)
    if name[0] in "LR" and name[1:2].isupper():  # LShoulder, RHip
        return ("R" if name[0] == "L" else "L") + name[1:]
    return name


def _build_map(rules: Sequence[str], joints: int) -> Float[np.ndarray, "20 joint"]:
    """Turn one rule per net joint into a matrix.

    A rule is `3` (that joint), `4+11` (their mean), `~0.19` (that share of the way from mid-hips to
    mid-shoulders), `hand` or `foot` (the limb's last bone extended, see HAND_REACH, FOOT_REACH).
    """
    one = np.eye(joints)
    rows = np.zeros((NET_JOINTS, joints))
    for k, rule in enumerate(rules):
        if rule[0].isdigit():
            rows[k] = np.mean([one[int(source)] for source in rule.split("+")], axis=0)
    hips = (rows[LEFT_HIP] + rows[RIGHT_HIP]) / 2
    shoulders = (rows[LEFT_SHOULDER] + rows[RIGHT_SHOULDER]) / 2
    for k, rule in enumerate(rules):
        if rule.startswith("~"):
            rows[k] = hips + float(rule[1:]) * (shoulders - hips)
        elif rule in {"hand", "foot"}:
            reach = HAND_REACH if rule == "hand" else FOOT_REACH
            rows[k] = rows[k - 1] + reach * (rows[k - 1] - rows[k - 2])
    return rows


def _define(
    name: str,
    joints: str,
    *,
    parents: tuple[int, ...] = (),
    bones: Bones = (),
    to_net: str,
    carry: str,
    root_relative: bool = False,
) -> Skeleton:
    """Build a format from its facts; tables are words separated by spaces."""
    names, rules = tuple(joints.split()), to_net.split()
    carried = np.array([int(k) for k in carry.split()], dtype=np.int64)
    direct = {int(rule): k for k, rule in enumerate(rules) if rule.isdigit()}
    forecast: tuple[Forecast, ...] = tuple(
        "net" if direct.get(j) == carried[j] else "carried" for j in range(len(names))
    )
    matrix = _build_map(rules, len(names))
    for array in (matrix, carried):
        array.setflags(write=False)
    return Skeleton(
        name=name,
        joints=names,
        parents=parents,
        bones=bones or tuple((parent, j) for j, parent in enumerate(parents) if parent >= 0),
        root_relative=root_relative,
        mirror=tuple(names.index(_other_side(joint)) for joint in names),
        to_net=matrix,
        carry=carried,
        forecast=forecast,
    )


_LIMBS = "4 5 6 7 8 9 10 11 12 13 14 15 16 17 18 19"
_SDK_LIMBS = """ShoulderLeft ElbowLeft WristLeft HandLeft ShoulderRight ElbowRight WristRight
    HandRight HipLeft KneeLeft AnkleLeft FootLeft HipRight KneeRight AnkleRight FootRight"""

_FORMATS: tuple[dict[str, Any], ...] = (
    {
        "name": "kinect_v1",
        "joints": """head shoulder_center spine hip_center
            left_shoulder left_elbow left_wrist left_hand
            right_shoulder right_elbow right_wrist right_hand
            left_hip left_knee left_ankle left_foot right_hip right_knee right_ankle right_foot""",
        "parents": (1, 2, 3, -1, 1, 4, 5, 6, 1, 8, 9, 10, 3, 12, 13, 14, 3, 16, 17, 18),
        "to_net": f"0 1 2 3 {_LIMBS}",
        "carry": f"0 1 2 3 {_LIMBS}",
    },
    {
        "name": "kinect_v1_sdk",
        "joints": f"HipCenter Spine ShoulderCenter Head {_SDK_LIMBS}",
        "parents": (-1, 0, 1, 2, 2, 4, 5, 6, 2, 8, 9, 10, 0, 12, 13, 14, 0, 16, 17, 18),
        "to_net": f"3 2 1 0 {_LIMBS}",
        "carry": f"3 2 1 0 {_LIMBS}",
    },
    {
        "name": "kinect_v2",
        "joints": f"""SpineBase SpineMid Neck Head {_SDK_LIMBS}
            SpineShoulder HandTipLeft ThumbLeft HandTipRight ThumbRight""",
        "parents": (
            *(-1, 0, 20, 2, 20, 4, 5, 6, 20, 8, 9, 10, 0, 12, 13, 14, 0, 16, 17, 18),
            *(1, 7, 6, 11, 10),
        ),
        "to_net": f"3 20 1 0 {_LIMBS}",
        "carry": f"3 2 1 0 {_LIMBS} 1 7 7 11 11",
    },
    {
        "name": "azure_kinect",
        "joints": """PELVIS SPINE_NAVEL SPINE_CHEST NECK
            CLAVICLE_LEFT SHOULDER_LEFT ELBOW_LEFT WRIST_LEFT HAND_LEFT HANDTIP_LEFT THUMB_LEFT
            CLAVICLE_RIGHT SHOULDER_RIGHT ELBOW_RIGHT WRIST_RIGHT HAND_RIGHT HANDTIP_RIGHT
            THUMB_RIGHT HIP_LEFT KNEE_LEFT ANKLE_LEFT FOOT_LEFT HIP_RIGHT KNEE_RIGHT ANKLE_RIGHT
            FOOT_RIGHT HEAD NOSE EYE_LEFT EAR_LEFT EYE_RIGHT EAR_RIGHT""",
        "parents": (
            *(-1, 0, 1, 2, 2, 4, 5, 6, 7, 8, 7, 2, 11, 12, 13, 14, 15, 14),
            *(0, 18, 19, 20, 0, 22, 23, 24, 3, 26, 26, 26, 26, 26),
        ),
        "to_net": "26 4+11 1 0 5 6 7 8 12 13 14 15 18 19 20 21 22 23 24 25",
        "carry": "3 2 2 1 1 4 5 6 7 7 7 1 8 9 10 11 11 11 12 13 14 15 16 17 18 19 0 0 0 0 0 0",
    },
    {
        "name": "mediapipe",
        "joints": """nose left_eye_inner left_eye left_eye_outer right_eye_inner right_eye
            right_eye_outer left_ear right_ear mouth_left mouth_right left_shoulder right_shoulder
            left_elbow right_elbow left_wrist right_wrist left_pinky right_pinky left_index
            right_index left_thumb right_thumb left_hip right_hip left_knee right_knee left_ankle
            right_ankle left_heel right_heel left_foot_index right_foot_index""",
        "bones": (
            *((0, 1), (1, 2), (2, 3), (3, 7), (0, 4), (4, 5), (5, 6), (6, 8), (9, 10), (11, 12)),
            *((11, 13), (13, 15), (15, 17), (15, 19), (15, 21), (17, 19)),
            *((12, 14), (14, 16), (16, 18), (16, 20), (16, 22), (18, 20)),
            *((11, 23), (12, 24), (23, 24), (23, 25), (25, 27), (27, 29), (27, 31), (29, 31)),
            *((24, 26), (26, 28), (28, 30), (28, 32), (30, 32)),
        ),
        "to_net": """7+8 ~1.28 ~0.37 ~0.19 11 13 15 17+19 12 14 16 18+20
            23 25 27 31 24 26 28 32""",
        "carry": """0 0 0 0 0 0 0 0 0 0 0 4 8 5 9 6 10 7 11 7 11 7 11
            12 16 13 17 14 18 14 18 15 19""",
        "root_relative": True,
    },
    {
        "name": "coco17",
        "joints": """nose left_eye right_eye left_ear right_ear left_shoulder right_shoulder
            left_elbow right_elbow left_wrist right_wrist left_hip right_hip left_knee right_knee
            left_ankle right_ankle""",
        "bones": (
            *((0, 1), (0, 2), (1, 2), (1, 3), (2, 4), (3, 5), (4, 6)),
            *((5, 6), (5, 7), (7, 9), (6, 8), (8, 10), (5, 11), (6, 12), (11, 12)),
            *((11, 13), (13, 15), (12, 14), (14, 16)),
        ),
        "to_net": "3+4 ~1.28 ~0.37 ~0.19 5 7 9 hand 6 8 10 hand 11 13 15 foot 12 14 16 foot",
        "carry": "0 0 0 0 0 4 8 5 9 6 10 12 16 13 17 14 18",
    },
    {
        "name": "body25",
        "joints": """Nose Neck RShoulder RElbow RWrist LShoulder LElbow LWrist MidHip RHip RKnee
            RAnkle LHip LKnee LAnkle REye LEye REar LEar LBigToe LSmallToe LHeel RBigToe RSmallToe
            RHeel""",
        "parents": (
            *(1, 8, 1, 2, 3, 1, 5, 6, -1, 8, 9, 10, 8, 12, 13),
            *(0, 0, 15, 16, 14, 19, 14, 11, 22, 11),
        ),
        "to_net": """17+18 ~1.28 ~0.37 ~0.19 5 6 7 hand 2 3 4 hand
            12 13 14 19+20 9 10 11 22+23""",
        "carry": "0 1 8 9 10 4 5 6 3 16 17 18 12 13 14 0 0 0 0 15 15 14 19 19 18",
    },
    {
        "name": "h36m17",
        "joints": """Hip RHip RKnee RFoot LHip LKnee LFoot Spine Thorax Neck/Nose Head
            LShoulder LElbow LWrist RShoulder RElbow RWrist""",
        "parents": (-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 9, 8, 11, 12, 8, 14, 15),
        "to_net": "9+10 8 7 0 11 12 13 hand 14 15 16 hand 4 5 6 foot 1 2 3 foot",
        "carry": "3 16 17 18 12 13 14 2 1 0 0 4 5 6 8 9 10",
    },
    {
        "name": "smpl24",
        "joints": """pelvis left_hip right_hip spine1 left_knee right_knee spine2 left_ankle
            right_ankle spine3 left_foot right_foot neck left_collar right_collar head
            left_shoulder right_shoulder left_elbow right_elbow left_wrist right_wrist
            left_hand right_hand""",
        "parents": (
            *(-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8),
            *(9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21),
        ),
        "to_net": "15 12 3 0 16 18 20 22 17 19 21 23 1 4 7 10 2 5 8 11",
        "carry": "3 12 16 2 13 17 2 14 18 2 15 19 1 1 1 0 4 8 5 9 6 10 7 11",
    },
)

SKELETONS: dict[str, Skeleton] = {facts["name"]: _define(**facts) for facts in _FORMATS}
"""Every format that the service takes, by its name on the wire."""

KINECT_V1 = SKELETONS["kinect_v1"]
"""The net's own skeleton."""
