"""Whether this is a person, in metres, the right way up: of use to streams and to trials.

Everything here works on poses in the net's skeleton with y up, and costs one small matrix product
per frame. Its thresholds were measured on recordings of real people; tests hold them to it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from models.skeleton import (
    HEAD,
    HIP_CENTER,
    LEFT_ANKLE,
    LEFT_ELBOW,
    LEFT_FOOT,
    LEFT_HIP,
    LEFT_KNEE,
    LEFT_SHOULDER,
    LEFT_WRIST,
    NET_JOINTS,
    RIGHT_ANKLE,
    RIGHT_ELBOW,
    RIGHT_FOOT,
    RIGHT_HIP,
    RIGHT_KNEE,
    RIGHT_SHOULDER,
    RIGHT_WRIST,
    SHOULDER_CENTER,
    SPINE,
)

BONES = 8
"""Lengths that `measure_bones` gives."""
FACTS = 4
"""Numbers that `measure_body` keeps of a frame."""
_TORSO, _UPRIGHT, _FACING, _ORDER = range(FACTS)

CUE_LIMIT = 0.3
"""One cue of the facing counts for at most this share of the torso: a raised leg is no proof."""


@dataclass(frozen=True, slots=True)
class GuardRules:
    """When a body is implausible.

    Attributes:
        torso_min_m, torso_max_m: plausible distance of shoulder centre and hip centre.
        upside_down_s: the head must stay below the hips for this long.
        facing_min: evidence (log odds) at which the sides are taken to be swapped.
        joint_speed_max: m/s between two frames of the window; sensors jump to 30 now and then.
        root_speed_max: m/s of the hip centre.
        forecast_speed_max: m/s of any joint within a forecast.
        frozen_poses: identical poses in a row that count as a frozen sensor.
        stranger_s: bones are measured over this long.
        stranger_max: mean difference of the logarithms of bone lengths at which one such measure
            shows somebody else. Sensors place joints so differently from pose to pose that nothing
            smaller tells.
        stranger_long_s: over this long, the median of the measures counts too.
        stranger_long_max: and that shows somebody else at this difference already.
    """

    torso_min_m: float = 0.25
    torso_max_m: float = 0.9
    upside_down_s: float = 1.0
    facing_min: float = 2.0
    joint_speed_max: float = 25.0
    root_speed_max: float = 8.0
    forecast_speed_max: float = 25.0
    frozen_poses: int = 10
    stranger_s: float = 1.0
    stranger_max: float = 0.18
    stranger_long_s: float = 5.0
    stranger_long_max: float = 0.13


def _combine(*terms: tuple[int, float]) -> Float[np.ndarray, "20"]:
    row = np.zeros(NET_JOINTS)
    for joint, share in terms:
        row[joint] += share
    return row


_CUES: tuple[tuple[float, Float[np.ndarray, "20"]], ...] = (
    (23.0, _combine((LEFT_FOOT, 0.5), (RIGHT_FOOT, 0.5), (LEFT_ANKLE, -0.5), (RIGHT_ANKLE, -0.5))),
    (
        5.0,
        _combine((LEFT_KNEE, 0.5), (LEFT_HIP, -0.25), (LEFT_ANKLE, -0.25))
        + _combine((RIGHT_KNEE, 0.5), (RIGHT_HIP, -0.25), (RIGHT_ANKLE, -0.25)),
    ),
    (
        -8.0,
        _combine((LEFT_ELBOW, 0.5), (LEFT_SHOULDER, -0.25), (LEFT_WRIST, -0.25))
        + _combine((RIGHT_ELBOW, 0.5), (RIGHT_SHOULDER, -0.25), (RIGHT_WRIST, -0.25)),
    ),
    (
        12.5,
        _combine((LEFT_WRIST, 1.0), (RIGHT_WRIST, 1.0))
        + _combine((LEFT_SHOULDER, -1.0), (RIGHT_SHOULDER, -1.0)),
    ),
    (12.0, _combine((HEAD, 1.0), (SHOULDER_CENTER, -1.0))),
    (-17.0, _combine((SPINE, 1.0), (HIP_CENTER, -0.5), (SHOULDER_CENTER, -0.5))),
)
"""What points forwards on a person, with its weight: toes, knees, hands and head do, elbows and the
bow of the spine point backwards. Odd under a swap of sides, so one line through 0 separates them.
The weights are a logistic regression on the training people of the recordings."""

CUE_WEIGHTS = np.array([weight for weight, _ in _CUES])
BODY_LINES = np.stack(
    [
        *(row for _, row in _CUES),
        _combine((LEFT_SHOULDER, 1.0), (RIGHT_SHOULDER, -1.0)),
        _combine((LEFT_HIP, 1.0), (RIGHT_HIP, -1.0)),
        _combine((SHOULDER_CENTER, 1.0), (HIP_CENTER, -1.0)),
        _combine((HEAD, 1.0), (HIP_CENTER, -1.0)),
        _combine((SHOULDER_CENTER, 1.0), (LEFT_HIP, -0.5), (RIGHT_HIP, -0.5)),
        _combine((HIP_CENTER, 1.0), (LEFT_HIP, -0.5), (RIGHT_HIP, -0.5)),
    ]
)
"""What `measure_body` measures: as many cues as there are weights, then lines between joints. The
kernel in models/runtime/native/body.h knows them by their places."""
_WEIGHTS = tuple(CUE_WEIGHTS.tolist())


def measure_body(pose: Float[np.ndarray, "20 3"]) -> tuple[float, float, float, float]:
    """Reduce one pose to what `judge_body` needs.

    Returns:
        Torso length (m); height of the head over the hip centre (m); evidence that the sides agree
        with the facing (log odds, negative for a mirrored person); how much nearer to the hips the
        hip centre is than the shoulder centre (m, negative where joints are in another order).
    """
    # numbers, not arrays, from here on: for three of them that is several times as fast
    rows = (BODY_LINES @ pose).tolist()
    shoulders, hips = rows[6], rows[7]
    spine = rows[8]  # the body's own up, so that who lies down or stands on the head has a front
    torso = math.hypot(*spine)
    wide, narrow = max(math.hypot(*shoulders), 0.05), max(math.hypot(*hips), 0.05)
    x, y, z = (a / wide + b / narrow for a, b in zip(shoulders, hips, strict=True))
    front = (y * spine[2] - z * spine[1], z * spine[0] - x * spine[2], x * spine[1] - y * spine[0])
    scale = max(math.hypot(*front), 1e-6) * max(torso, 0.1)
    facing = 0.0
    for row, weight in zip(rows, _WEIGHTS, strict=False):
        cue = (row[0] * front[0] + row[1] * front[1] + row[2] * front[2]) / scale
        facing += weight * min(max(cue, -CUE_LIMIT), CUE_LIMIT)
    return torso, rows[9][1], facing, math.hypot(*rows[10]) - math.hypot(*rows[11])


def judge_body(
    facts: Float[np.ndarray, "frames 4"],
    times: Float[np.ndarray, " frames"],
    *,
    rules: GuardRules,
    whole: bool = False,
) -> tuple[str, ...]:
    """Name what is implausible about the last second of a person.

    Args:
        facts: what `measure_body` gave for each frame, oldest first.
        times: seconds, in any clock.
        rules: the thresholds.
        whole: these frames are all that there will ever be (a single request), so a head below the
            hips in all of them is enough.
    """
    begin = int(np.searchsorted(times, times[-1] - rules.upside_down_s))
    recent = facts[begin:]
    # a frame before the second began shows that all of it was seen
    seen_enough = whole or begin > 0 or times[-1] - times[0] >= rules.upside_down_s
    means, tops = recent.mean(axis=0).tolist(), recent.max(axis=0).tolist()
    return judge_sums(means, tops, rules=rules, seen_enough=bool(seen_enough))


def judge_sums(
    means: Sequence[float], tops: Sequence[float], *, rules: GuardRules, seen_enough: bool
) -> tuple[str, ...]:
    """Name what is implausible about a person whose last second was summed up.

    Args:
        means: of each of the facts over the second.
        tops: the greatest of each.
        rules: the thresholds.
        seen_enough: whether all of the second was seen.
    """
    flags = []
    if means[_ORDER] < 0:
        flags.append("implausible_pose")
    if not rules.torso_min_m <= means[_TORSO] <= rules.torso_max_m:
        flags.append("implausible_units")
    if means[_FACING] < -rules.facing_min:
        flags.append("mirrored")
    if seen_enough and tops[_UPRIGHT] < 0:
        flags.append("upside_down")
    return tuple(flags)


def measure_bones(poses: Float[np.ndarray, "time 20 3"]) -> Float[np.ndarray, "8"]:
    """Give the lengths of a person's bones, as logarithms, both sides averaged.

    Head, back, half shoulders, upper arm, forearm, half hips, thigh, shank: the median over time,
    because a sensor that guesses guesses differently from frame to frame. Hands and feet are left
    out: sensors place them anywhere.
    """
    lines = _BONE_LINES @ poses
    merged = _BONE_GROUPS @ _find_medians(np.sqrt(np.vecdot(lines, lines)))
    return np.asarray(np.log(np.maximum(merged, 1e-3)))


def _find_medians(rows: Float[np.ndarray, "row column"]) -> Float[np.ndarray, " column"]:
    """Give the median of each column, for few rows several times as fast as numpy's."""
    ordered, count = np.sort(rows, axis=0), len(rows)
    return np.asarray((ordered[(count - 1) // 2] + ordered[count // 2]) / 2)


def is_stranger(
    seconds: Sequence[Float[np.ndarray, "8"]],
    known: Float[np.ndarray, "8"],
    *,
    rules: GuardRules,
    long: bool = False,
) -> bool:
    """Tell whether somebody else is seen than the one whose bones are known.

    Args:
        seconds: what `measure_bones` gave for the last seconds, the newest at the end.
        known: the bones of the person.
        rules: the thresholds.
        long: whether these measures are of as long as `rules.stranger_long_s`.
    """
    if float(np.abs(seconds[-1] - known).mean()) > rules.stranger_max:
        return True
    if not long:
        return False
    return float(np.abs(_find_medians(np.array(seconds)) - known).mean()) > rules.stranger_long_max


_BONES: tuple[tuple[tuple[int, int], ...], ...] = (
    ((SHOULDER_CENTER, HEAD),),
    ((HIP_CENTER, SPINE), (SPINE, SHOULDER_CENTER)),
    ((SHOULDER_CENTER, LEFT_SHOULDER), (SHOULDER_CENTER, RIGHT_SHOULDER)),
    ((LEFT_SHOULDER, LEFT_ELBOW), (RIGHT_SHOULDER, RIGHT_ELBOW)),
    ((LEFT_ELBOW, LEFT_WRIST), (RIGHT_ELBOW, RIGHT_WRIST)),
    ((HIP_CENTER, LEFT_HIP), (HIP_CENTER, RIGHT_HIP)),
    ((LEFT_HIP, LEFT_KNEE), (RIGHT_HIP, RIGHT_KNEE)),
    ((LEFT_KNEE, LEFT_ANKLE), (RIGHT_KNEE, RIGHT_ANKLE)),
)
_PAIRS = [pair for group in _BONES for pair in group]
_BONE_LINES = np.stack([_combine((end, 1.0), (start, -1.0)) for start, end in _PAIRS])
_BONE_GROUPS = np.array([[pair in group for pair in _PAIRS] for group in _BONES], dtype=np.float64)
