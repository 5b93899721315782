"""Raw frames of any sensor, made into what is trained on: the net's skeleton, y up, 30 Hz, whole.

Recordings are looked at as a whole, so holes are bridged between both of their ends, where a
stream can only carry on. Where the person was lost for longer, the clip is cut in two.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from app.domain.recordings import RawFrames
from models.skeleton import HIP_CENTER, Skeleton, to_y_up
from models.spec import MotionSpec

SNAP_S = 1e-5
"""Times this close to the grid are on it: then the frames are taken as they are."""


@dataclass(frozen=True, slots=True)
class ConvertRules:
    """How raw frames become whole ones.

    Attributes:
        gap_s: a longer step between frames cuts the clip.
        lost_s: the hips, or most joints, missing for longer than this cut it too.
        confidence_min: a joint below it is missing.
    """

    gap_s: float = 0.1
    lost_s: float = 0.1
    confidence_min: float = 0.3


def convert_clip(
    frames: RawFrames,
    skeleton: Skeleton,
    *,
    up: str,
    rules: ConvertRules | None = None,
    spec: MotionSpec | None = None,
) -> list[Float[np.ndarray, "time 20 3"]]:
    """Cut a clip where the person was lost, and bring each piece to the net's grid.

    Args:
        frames: as received.
        skeleton: the user's format.
        up: the user's up axis.
        rules: what counts as a hole.
        spec: rate and window of the net.

    Returns:
        Pieces of at least one window, in metres; none where the person was never seen for that
        long. Frames that are whole and on the grid come through bit for bit.
    """
    rules, spec = rules or ConvertRules(), spec or MotionSpec()
    known = find_known(frames, confidence_min=rules.confidence_min)
    seen = known.any(axis=1) & (2 * known.sum(axis=1) >= known.shape[1])
    seen &= known[:, skeleton.to_net[HIP_CENTER] != 0].all(axis=1)
    pieces = []
    for piece in _split(frames.t, seen, rules):
        poses = _fill(frames.joints[piece].astype(np.float64), known[piece], skeleton)
        moved = poses if up == "y" else to_y_up(poses, up)
        net = moved if _is_net(skeleton) else np.asarray(skeleton.to_net @ moved)
        gridded = _resample(frames.t[piece], net, rate_hz=spec.rate_hz)
        if len(gridded) >= spec.frames:
            pieces.append(gridded)
    return pieces


def find_known(frames: RawFrames, *, confidence_min: float) -> Bool[np.ndarray, "time joint"]:
    """Tell which joints of which frames were seen."""
    known = ~np.isnan(frames.joints).any(axis=2)
    if frames.confidence is not None:
        known &= frames.confidence >= confidence_min
    return np.asarray(known)


def _split(
    t: Float[np.ndarray, " time"], seen: Bool[np.ndarray, " time"], rules: ConvertRules
) -> list[np.ndarray]:
    """Give the frames of each piece, by index; frames without the person are left out."""
    indices = np.flatnonzero(seen)
    if len(indices) == 0:
        return []
    cuts = np.flatnonzero(np.diff(t[indices]) > max(rules.gap_s, rules.lost_s) + SNAP_S) + 1
    return np.split(indices, cuts)


def _fill(
    poses: Float[np.ndarray, "time joint 3"],
    known: Bool[np.ndarray, "time joint"],
    skeleton: Skeleton,
) -> Float[np.ndarray, "time joint 3"]:
    """Bridge each joint's holes by a line of its place relative to the hips."""
    if known.all():
        return poses
    rows = np.arange(len(poses))
    weights = skeleton.to_net[HIP_CENTER]
    root = np.einsum("j,tjc->tc", weights, np.where(known[..., None], poses, 0.0))
    filled = poses.copy()
    for joint in np.flatnonzero(~known.all(axis=0)):
        there = known[:, joint]
        if not there.any():
            filled[:, joint] = root
            continue
        for axis in range(3):
            offset = poses[there, joint, axis] - root[there, axis]
            bridged = np.interp(rows[~there], rows[there], offset)
            filled[~there, joint, axis] = bridged + root[~there, axis]
    return filled


def _resample(
    t: Float[np.ndarray, " time"], poses: Float[np.ndarray, "time 20 3"], *, rate_hz: float
) -> Float[np.ndarray, "grid 20 3"]:
    """Give the poses on a grid of the net's rate that begins at the first frame."""
    ago = t - t[0]
    grid = np.arange(int(np.floor((ago[-1] + SNAP_S) * rate_hz)) + 1) / rate_hz
    if len(grid) == len(t) and np.abs(ago - grid).max() <= SNAP_S:
        return poses
    left = np.clip(np.searchsorted(ago, grid + SNAP_S, side="right") - 1, 0, len(t) - 2)
    share = np.clip((grid - ago[left]) / (ago[left + 1] - ago[left]), 0.0, 1.0)
    share = share[:, None, None]
    return np.asarray(poses[left] * (1 - share) + poses[left + 1] * share)


def _is_net(skeleton: Skeleton) -> bool:
    return np.array_equal(skeleton.to_net, np.eye(len(skeleton.to_net), len(skeleton.joints)))
