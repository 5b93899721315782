"""The body of a synthetic person: bones of constant length, posed by a few controls.

The trunk is posed by forward kinematics, arms and legs by where wrists and ankles are to be. The
frame is that of UTD-MHAD: metres, y up, right-handed; at heading 0 a person faces the sensor, that
is -z, with the right side at +x. In a person's own axes x is right, y up and z backward.
"""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from jaxtyping import Float64

from models import skeleton as k

_REFERENCE_HEIGHT_M = 1.66
_OFFSETS_M = {
    # Bones as Kinect v1 sees them: medians over UTD-MHAD's subjects 1, 3, 5, 7.
    "spine": (0.0, 0.063, 0.040),
    "neck": (0.0, 0.337, -0.012),
    "head": (0.0, 0.183, -0.025),
    "shoulder": (0.156, -0.111, 0.0),
    "hip": (0.072, -0.072, 0.0),
    "foot": (0.012, -0.062, -0.045),
}
_LENGTHS_M = {"upper_arm": 0.258, "forearm": 0.230, "hand": 0.065, "thigh": 0.430, "shank": 0.372}
_SHRUG_RAD = 0.13
_ELBOW_POLE = (0.3, -0.8, 0.9)
_KNEE_POLE = (0.12, 0.0, -1.0)
_STRAIGHT = 0.995
_SOFTNESS = 0.006
_CLOSEST = 0.02


class Control(IntEnum):
    """What poses a body, one column each. Arms in arm lengths, pelvis in leg lengths, radians."""

    DROP = 0  # pelvis below standing
    BACK = 1  # pelvis behind the feet
    SIDE = 2  # pelvis to the right
    LEAN = 3  # trunk forward
    BEND = 4  # trunk to the right
    TWIST = 5  # shoulders turned to the left against the hips
    NOD = 6  # head forward
    LOOK = 7  # head to the left
    RIGHT_OUT = 8  # wrist from its shoulder: away from the body, up, forward
    RIGHT_UP = 9
    RIGHT_FORWARD = 10
    LEFT_OUT = 11
    LEFT_UP = 12
    LEFT_FORWARD = 13


CONTROLS = len(Control)


@dataclass(frozen=True, eq=False)
class Feet:
    """Where the feet are: [time, 2 (right, left)] each.

    Attributes:
        position: [time, 2, 3] of the point below each ankle, in the room, with the floor at 0.
        heading: radians.
        pitch: radians, heel above toes positive.
    """

    position: Float64[np.ndarray, "time 2 3"]
    heading: Float64[np.ndarray, "time 2"]
    pitch: Float64[np.ndarray, "time 2"]


@dataclass(frozen=True, eq=False)
class Body:
    """A body's constant sizes in metres, the same on both sides.

    `offsets` are those of the right side in the axes of the part that they hang on.
    """

    height: float
    offsets: dict[str, Float64[np.ndarray, "3"]]
    lengths: dict[str, float]

    @property
    def arm(self) -> float:
        """Shoulder to wrist."""
        return self.lengths["upper_arm"] + self.lengths["forearm"]

    @property
    def leg(self) -> float:
        """Hip to ankle."""
        return self.lengths["thigh"] + self.lengths["shank"]

    @property
    def ankle_height(self) -> float:
        """Ankle above the floor when the foot is flat."""
        return float(-self.offsets["foot"][1])

    @property
    def half_stance(self) -> float:
        """From the middle to each foot, standing."""
        return float(self.offsets["hip"][0]) * 1.15


def draw_body(random: np.random.Generator) -> Body:
    """Draw a height of 1.5 to 1.95 m and proportions that differ from person to person."""
    height = float(np.clip(random.normal(1.71, 0.10), 1.5, 1.95))
    scale = height / _REFERENCE_HEIGHT_M
    legs, arms = _draw_near_one(random, 0.025), _draw_near_one(random, 0.025)
    part = {"upper_arm": arms, "forearm": arms, "hand": arms, "thigh": legs, "shank": legs}
    breadth = _draw_near_one(random, 0.06)
    offsets = {name: np.array(xyz) * scale for name, xyz in _OFFSETS_M.items()}
    for name in ("shoulder", "hip"):
        offsets[name] = offsets[name] * (breadth, 1.0, 1.0)
    offsets["neck"] = offsets["neck"] * _draw_near_one(random, 0.03)
    lengths = {
        name: metres * scale * part[name] * _draw_near_one(random, 0.02)
        for name, metres in _LENGTHS_M.items()
    }
    return Body(height=height, offsets=offsets, lengths=lengths)


def _draw_near_one(random: np.random.Generator, deviation: float) -> float:
    return float(
        np.clip(random.normal(1.0, deviation), 1.0 - 2.0 * deviation, 1.0 + 2.0 * deviation)
    )


def pose_body(
    body: Body,
    *,
    place: Float64[np.ndarray, "time 3"],
    heading: Float64[np.ndarray, " time"],
    controls: Float64[np.ndarray, "time control"],
    feet: Feet,
) -> Float64[np.ndarray, "time 20 3"]:
    """Pose a body.

    Args:
        body: its sizes.
        place: the point of the floor at which it stands.
        heading: radians; 0 faces -z, positive turns to the left.
        controls: one column for each `Control`.
        feet: where the feet are; out of reach, the legs stretch towards them.

    Returns:
        poses in the net's skeleton, in the frame of `place`.
    """
    joints = np.empty((len(place), k.NET_JOINTS, 3))
    hips = (
        yaw(heading)
        @ _pitch(-0.35 * controls[:, Control.LEAN])
        @ _roll(-0.3 * controls[:, Control.BEND])
    )
    chest = hips @ yaw(controls[:, Control.TWIST]) @ _pitch(-0.65 * controls[:, Control.LEAN])
    chest = chest @ _roll(-0.7 * controls[:, Control.BEND])
    skull = chest @ yaw(controls[:, Control.LOOK]) @ _pitch(-controls[:, Control.NOD])
    joints[:, k.HIP_CENTER] = place + _place_pelvis(body, heading, controls)
    joints[:, k.SPINE] = joints[:, k.HIP_CENTER] + hips @ body.offsets["spine"]
    joints[:, k.SHOULDER_CENTER] = joints[:, k.SPINE] + chest @ body.offsets["neck"]
    joints[:, k.HEAD] = joints[:, k.SHOULDER_CENTER] + skull @ body.offsets["head"]
    for side, (shoulder, hip) in enumerate(
        ((k.RIGHT_SHOULDER, k.RIGHT_HIP), (k.LEFT_SHOULDER, k.LEFT_HIP))
    ):
        outward = 1.0 - 2.0 * side
        first = (Control.RIGHT_OUT, Control.LEFT_OUT)[side]
        _pose_arm(
            joints, body, chest, controls[:, first : first + 3], shoulder=shoulder, outward=outward
        )
        _pose_leg(joints, body, hips, feet, side=side, hip=hip, outward=outward)
    return joints


def yaw(angle: Float64[np.ndarray, "*any"]) -> Float64[np.ndarray, "*any 3 3"]:
    """Turn about the vertical; positive to the left of a person."""
    cos, sin, zero, one = np.cos(angle), np.sin(angle), np.zeros_like(angle), np.ones_like(angle)
    return _matrix(cos, zero, sin, zero, one, zero, -sin, zero, cos)


def _pitch(angle: Float64[np.ndarray, "*any"]) -> Float64[np.ndarray, "*any 3 3"]:
    """Turn about the axis to the right; negative leans forward."""
    cos, sin, zero, one = np.cos(angle), np.sin(angle), np.zeros_like(angle), np.ones_like(angle)
    return _matrix(one, zero, zero, zero, cos, -sin, zero, sin, cos)


def _roll(angle: Float64[np.ndarray, "*any"]) -> Float64[np.ndarray, "*any 3 3"]:
    """Turn about the axis to the back; negative bends to the right."""
    cos, sin, zero, one = np.cos(angle), np.sin(angle), np.zeros_like(angle), np.ones_like(angle)
    return _matrix(cos, -sin, zero, sin, cos, zero, zero, zero, one)


def _matrix(*entries: Float64[np.ndarray, "*any"]) -> Float64[np.ndarray, "*any 3 3"]:
    return np.stack(entries, axis=-1).reshape(*entries[0].shape, 3, 3)


def _place_pelvis(
    body: Body, heading: Float64[np.ndarray, " time"], controls: Float64[np.ndarray, "time control"]
) -> Float64[np.ndarray, "time 3"]:
    standing = body.ankle_height + _STRAIGHT * body.leg - body.offsets["hip"][1]
    shift = np.stack(
        (controls[:, Control.SIDE], -controls[:, Control.DROP], controls[:, Control.BACK]), axis=-1
    )
    return np.asarray(_turn(yaw(heading), shift * body.leg) + np.array((0.0, standing, 0.0)))


def _pose_arm(
    joints: Float64[np.ndarray, "time 20 3"],
    body: Body,
    chest: Float64[np.ndarray, "time 3 3"],
    wrist: Float64[np.ndarray, "time 3"],
    *,
    shoulder: int,
    outward: float,
) -> None:
    # A raised arm takes its shoulder along.
    shrug = _roll(outward * _SHRUG_RAD * (1.0 + wrist[:, 1]))
    side = np.array((outward, 1.0, 1.0))
    joints[:, shoulder] = joints[:, k.SHOULDER_CENTER] + _turn(
        chest @ shrug, np.broadcast_to(body.offsets["shoulder"] * side, wrist.shape)
    )
    target = _turn(chest, wrist * (outward, 1.0, -1.0)) * body.arm
    pole = chest @ (np.array(_ELBOW_POLE) * side)
    upper, lower = body.lengths["upper_arm"], body.lengths["forearm"]
    elbow, reached = _bend(target, pole, upper=upper, lower=lower)
    joints[:, shoulder + 1] = joints[:, shoulder] + elbow
    joints[:, shoulder + 2] = joints[:, shoulder] + reached
    forearm = (reached - elbow) / lower
    joints[:, shoulder + 3] = joints[:, shoulder + 2] + forearm * body.lengths["hand"]


def _pose_leg(
    joints: Float64[np.ndarray, "time 20 3"],
    body: Body,
    hips: Float64[np.ndarray, "time 3 3"],
    feet: Feet,
    *,
    side: int,
    hip: int,
    outward: float,
) -> None:
    mirrored = np.array((outward, 1.0, 1.0))
    joints[:, hip] = joints[:, k.HIP_CENTER] + hips @ (body.offsets["hip"] * mirrored)
    sole = yaw(feet.heading[:, side])
    # The heel rises about the toes: the ankle goes up and forward, the toes stay.
    foot = sole @ _pitch(-feet.pitch[:, side]) @ (body.offsets["foot"] * mirrored)
    flat = sole @ (body.offsets["foot"] * mirrored)
    ankle = feet.position[:, side] + (0.0, body.ankle_height, 0.0) + flat - foot
    knee, reached = _bend(
        ankle - joints[:, hip],
        sole @ (np.array(_KNEE_POLE) * mirrored),
        upper=body.lengths["thigh"],
        lower=body.lengths["shank"],
    )
    joints[:, hip + 1] = joints[:, hip] + knee
    joints[:, hip + 2] = joints[:, hip] + reached
    joints[:, hip + 3] = joints[:, hip + 2] + foot


def _bend(
    target: Float64[np.ndarray, "time 3"],
    pole: Float64[np.ndarray, "time 3"],
    *,
    upper: float,
    lower: float,
) -> tuple[Float64[np.ndarray, "time 3"], Float64[np.ndarray, "time 3"]]:
    """Bend two bones so that they reach towards `target`, the middle joint towards `pole`.

    Returns the middle joint and the end, both from the root; lengths are kept exactly, and the end
    comes softly to a stop where the target is out of reach.
    """
    distance = np.linalg.norm(target, axis=-1)
    longest, shortest = (upper + lower) * _STRAIGHT, abs(upper - lower) + _CLOSEST
    kept = longest - _SOFTNESS * np.logaddexp(0.0, (longest - distance) / _SOFTNESS)
    kept = np.maximum(kept, shortest)
    along = target / np.maximum(distance, 1e-9)[:, None]
    across = pole - (pole * along).sum(-1, keepdims=True) * along
    across /= np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-9)
    ahead = (upper**2 - lower**2 + kept**2) / (2.0 * kept)
    aside = np.sqrt(np.maximum(upper**2 - ahead**2, 0.0))
    return ahead[:, None] * along + aside[:, None] * across, kept[:, None] * along


def _turn(
    rotation: Float64[np.ndarray, "time 3 3"], vector: Float64[np.ndarray, "time 3"]
) -> Float64[np.ndarray, "time 3"]:
    return np.asarray(np.einsum("tij,tj->ti", rotation, vector))
