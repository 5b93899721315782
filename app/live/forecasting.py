"""From the engine's displacements to an answer in the user's own skeleton and frame of reference.

The stream and the single request both end here.
"""

from functools import lru_cache

import numpy as np
from jaxtyping import Float, Float32, Float64
from msgspec import Struct

from app.domain.motion import Severity, Timing, VersionStamp, worst_severity
from app.live.window import WindowReady
from app.live.work import EngineResult
from models.skeleton import Skeleton, from_y_up
from models.spec import MotionSpec


class Answer(Struct, frozen=True):
    """One forecast as a client gets it.

    Attributes:
        frames: metres, in the user's skeleton and frame; every coordinate finite.
        t_out: times of the frames on the client's clock, seconds.
        radius: metres, per joint of the user; None where it is not calibrated.
        coverage: probability that the radius has.
        version: the weights that answered.
        quality: flags of the input and of how the forecast came about.
        severity: that of the worst flag.
        filled: names of the joints that were carried.
        timing: where the time went.
    """

    frames: Float32[np.ndarray, "15 joint 3"]
    t_out: Float64[np.ndarray, "15"]
    radius: Float32[np.ndarray, "15 joint"] | None
    coverage: float
    version: VersionStamp
    quality: tuple[str, ...]
    severity: Severity
    filled: tuple[str, ...]
    timing: Timing


def make_answer(
    ready: WindowReady,
    result: EngineResult,
    *,
    skeleton: Skeleton,
    up: str,
    flags: tuple[str, ...] = (),
    spec: MotionSpec | None = None,
) -> Answer:
    """Add the displacements to the joints that were observed last, so nothing jumps at the seam.

    Args:
        ready: the window that was forecast.
        result: what the engine made of it.
        skeleton: the user's format; joints that the net lacks move with their nearest one.
        up: the user's up axis.
        flags: more quality flags, of how the input came.
        spec: shape of the task.
    """
    rate_hz = (spec or MotionSpec()).rate_hz
    quality = tuple(dict.fromkeys((*ready.flags, *result.flags, *flags)))
    radius = result.radius
    if radius is not None and not skeleton.is_net:
        radius = radius[:, skeleton.carry]
    return Answer(
        frames=add_displacement(ready.last_joints, result.displacement, skeleton=skeleton, up=up),
        t_out=ready.t + _list_steps(len(result.displacement), rate_hz),
        radius=radius,
        coverage=result.coverage,
        version=result.version,
        quality=quality,
        severity=_judge(quality),
        filled=ready.filled,
        timing=result.timing,
    )


def add_displacement(
    last_joints: Float[np.ndarray, "joint 3"],
    displacement: Float[np.ndarray, "horizon 20 3"],
    *,
    skeleton: Skeleton,
    up: str,
) -> Float32[np.ndarray, "horizon joint 3"]:
    """Move the joints of a user as the net's joints move.

    Args:
        last_joints: metres, in the user's skeleton and frame.
        displacement: metres, net skeleton, y up.
        skeleton: the user's format.
        up: the user's up axis.
    """
    carried = displacement if skeleton.is_net else displacement[:, skeleton.carry]
    turned = carried if up == "y" else from_y_up(carried.astype(np.float64), up)
    return np.asarray((last_joints + turned).astype(np.float32))


_judge = lru_cache(maxsize=256)(worst_severity)


@lru_cache(maxsize=16)
def _list_steps(count: int, rate_hz: float) -> Float64[np.ndarray, " step"]:
    """List the seconds from the last observed pose to each forecast one."""
    steps = np.arange(1, count + 1) / rate_hz
    steps.flags.writeable = False
    return steps
