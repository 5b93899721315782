"""A person to try things with, where there is no sensor yet: a stick figure that waves."""

import numpy as np
import numpy.typing as npt

JOINTS = (
    "head",
    "shoulder_center",
    "spine",
    "hip_center",
    "left_shoulder",
    "left_elbow",
    "left_wrist",
    "left_hand",
    "right_shoulder",
    "right_elbow",
    "right_wrist",
    "right_hand",
    "left_hip",
    "left_knee",
    "left_ankle",
    "left_foot",
    "right_hip",
    "right_knee",
    "right_ankle",
    "right_foot",
)
"""The joints of `kinect_v1`, in order."""

_STANDING_M = np.array(
    [
        (0.00, 0.62, 0.00),
        (0.00, 0.43, 0.02),
        (0.00, 0.06, 0.03),
        (0.00, 0.00, 0.00),
        (-0.16, 0.32, 0.02),
        (-0.20, 0.06, 0.05),
        (-0.20, -0.16, 0.00),
        (-0.20, -0.22, -0.02),
        (0.16, 0.32, 0.02),
        (0.27, 0.10, 0.02),
        (0.27, 0.33, 0.02),
        (0.27, 0.40, 0.02),
        (-0.07, -0.07, 0.00),
        (-0.08, -0.50, -0.02),
        (-0.09, -0.87, 0.02),
        (-0.10, -0.93, -0.05),
        (0.07, -0.07, 0.00),
        (0.08, -0.50, -0.02),
        (0.09, -0.87, 0.02),
        (0.10, -0.93, -0.05),
    ]
)
_ELBOW, _WRIST, _HAND = (JOINTS.index(f"right_{part}") for part in ("elbow", "wrist", "hand"))
_AWAY_M = np.array((0.0, 0.0, 2.5))


def waving_person(seconds: float = 5.0, rate_hz: float = 30.0) -> npt.NDArray[np.float64]:
    """Make poses of a person who faces the sensor and waves with the right hand.

    Args:
        seconds: how long.
        rate_hz: poses a second.

    Returns:
        [T, 20, 3] metres in the joints of `kinect_v1`: x to one side, y up, z away from the sensor.
    """
    t = np.arange(round(seconds * rate_hz)) / rate_hz
    poses = np.tile(_STANDING_M + _AWAY_M, (len(t), 1, 1))
    angle = 0.2 + 0.5 * np.sin(2.0 * np.pi * 0.8 * t)
    aim = np.stack((np.sin(angle), np.cos(angle), np.zeros_like(t)), axis=1)
    for joint, reach_m in ((_WRIST, 0.23), (_HAND, 0.30)):
        poses[:, joint] = poses[:, _ELBOW] + reach_m * aim
    poses[:, :, 0] += 0.02 * np.sin(2.0 * np.pi * 0.3 * t)[:, None]
    return poses
