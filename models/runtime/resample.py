"""What is done with every frame of every stream: the window on its grid, and how fast it moves.

By the kernel in `native/` where it was built, else by numpy: the same numbers.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from models.runtime.fused import KERNEL


class Survey(NamedTuple):
    """What there is to know of some frames.

    Attributes:
        poses: on the grid; metres, in any frame of reference.
        longest_s: the longest step of time between the frames that the grid spans.
        earlier: how many frames are older than the recent ones.
        means, tops: of each fact over the recent frames: the mean and the greatest.
    """

    poses: Float64[np.ndarray, "points joint 3"]
    longest_s: float
    earlier: int
    means: tuple[float, ...]
    tops: tuple[float, ...]


def survey(
    times: Float64[np.ndarray, " rows"],
    poses: Float64[np.ndarray, "rows joint 3"],
    facts: Float64[np.ndarray, "rows fact"],
    part: tuple[int, int],
    grid: Float64[np.ndarray, " points"],
    *,
    snap_s: float,
    recent_s: float,
) -> Survey:
    """Put poses on a grid, by lines between neighbours, and sum up what was measured of them.

    Args:
        times: strictly increasing in that part, seconds.
        poses: metres, in any frame of reference.
        facts: what was measured of each pose.
        part: the first row that counts, and the one behind the last. The arrays are contiguous.
        grid: seconds from the newest frame on, increasing and at most 0. A point before the oldest
            frame holds that one's pose.
        snap_s: a point this close to a frame is that frame.
        recent_s: frames up to this much older than the newest are recent.
    """
    start, end = part
    if KERNEL is None:
        rows = slice(start, end)
        return _survey_by_numpy(times[rows], poses[rows], facts[rows], grid, snap_s, recent_s)
    out = np.empty((len(grid), *poses.shape[1:]))
    longest_s, earlier, (means, tops) = KERNEL.survey(
        times, poses, facts, start, end, grid, snap_s, recent_s, out
    )
    return Survey(out, longest_s, earlier, means, tops)


def find_fastest(poses: Float64[np.ndarray, "time joint 3"], *, root: int) -> tuple[float, float]:
    """Give the largest squared step of any joint, and of the joint `root`, between two poses.

    Args:
        poses: metres.
        root: index of a joint.

    Returns:
        Square metres; not a number where a coordinate is none.
    """
    if KERNEL is not None:
        fastest: tuple[float, float] = KERNEL.find_fastest(
            np.ascontiguousarray(poses, np.float64), poses.shape[1], root
        )
        return fastest
    if len(poses) < 2:
        return 0.0, 0.0
    steps = poses[1:] - poses[:-1]
    squared = np.vecdot(steps, steps)
    return float(squared.max()), float(squared[:, root].max())


def _survey_by_numpy(
    times: Float64[np.ndarray, " frames"],
    poses: Float64[np.ndarray, "frames joint 3"],
    facts: Float64[np.ndarray, "frames fact"],
    grid: Float64[np.ndarray, " points"],
    snap_s: float,
    recent_s: float,
) -> Survey:
    earlier = int(np.searchsorted(times, times[-1] - recent_s))
    recent = facts[earlier:]
    means, tops = tuple(recent.mean(axis=0).tolist()), tuple(recent.max(axis=0).tolist())
    return Survey(*_resample(times, poses, grid, snap_s), earlier, means, tops)


def _resample(
    times: Float64[np.ndarray, " frames"],
    poses: Float64[np.ndarray, "frames joint 3"],
    grid: Float64[np.ndarray, " points"],
    snap_s: float,
) -> tuple[Float64[np.ndarray, "points joint 3"], float]:
    ago = times - times[-1]
    left = np.searchsorted(ago, grid + snap_s, side="right") - 1
    left = np.clip(left, 0, len(ago) - 1)
    right = np.minimum(left + 1, len(ago) - 1)
    past = grid - ago[left]
    step = np.where(right > left, ago[right] - ago[left], 1.0)
    share = np.where(past > snap_s, past / step, 0.0)[:, None, None]
    steps = np.diff(times[left[0] :])
    longest = float(steps.max()) if len(steps) else 0.0
    return poses[left] + share * (poses[right] - poses[left]), longest
