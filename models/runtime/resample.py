"""What is done with every frame of every stream: the window on its grid, and how fast it moves.

By the kernel in `native/` where it was built, else by numpy: the same numbers.
"""

import numpy as np
from jaxtyping import Float64

from models.runtime.fused import KERNEL


def resample(
    times: Float64[np.ndarray, " frames"],
    poses: Float64[np.ndarray, "frames joint 3"],
    grid: Float64[np.ndarray, " points"],
    *,
    snap_s: float,
) -> tuple[Float64[np.ndarray, "points joint 3"], float]:
    """Put poses on a grid, by lines between neighbours.

    Args:
        times: strictly increasing, seconds.
        poses: metres, in any frame of reference.
        grid: seconds from the newest frame on, increasing and at most 0. A point before the oldest
            frame holds that one's pose.
        snap_s: a point this close to a frame is that frame.

    Returns:
        The poses, and the longest step of time between the frames that the grid spans (seconds).
    """
    if KERNEL is None:
        return _resample_by_numpy(times, poses, grid, snap_s)
    out = np.empty((len(grid), *poses.shape[1:]))
    given = [np.ascontiguousarray(part, np.float64) for part in (times, poses, grid)]
    return out, KERNEL.resample(*given, snap_s, out)


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


def _resample_by_numpy(
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
