"""What counts as a frame, before it is sent."""

import math

import numpy as np
import numpy.typing as npt

from kinecast_client.errors import FrameError

COORDINATE_MAX_M = 100.0
CLOCK_RESTART_S = 1.0
"""A clock that goes back by more than this was restarted; by less, the frame is refused."""
RATE_SLACK = 0.9

Array = npt.ArrayLike


def read_joints(joints: Array | None, count: int | None) -> npt.NDArray[np.float32] | None:
    """Copy the joints of a frame: [J, 3] metres, NaN where missing.

    Raises:
        FrameError: they have another shape, or are no numbers.
    """
    if joints is None:
        return None
    pose = _copy(joints, "joints must be numbers [J, 3]")
    if pose.ndim != 2 or pose.shape[1] != 3 or len(pose) != (count or len(pose)):
        wanted = f"[{count or 'J'}, 3]"
        raise FrameError(f"joints must have the shape {wanted}, got {list(pose.shape)}.")
    return pose


def read_confidence(confidence: Array | None, count: int | None) -> npt.NDArray[np.float32] | None:
    """Copy the confidences of a frame: [J], cut to 0 to 1; NaN is 0.

    Raises:
        FrameError: they have another shape, or are no numbers.
    """
    if confidence is None:
        return None
    values = _copy(confidence, "confidence must be numbers [J]")
    if values.ndim != 1 or len(values) != (count or len(values)):
        raise FrameError(f"confidence must have the shape [{count or 'J'}], got {values.shape}.")
    return np.clip(np.nan_to_num(values, nan=0.0), 0.0, 1.0)


def read_time(t: object) -> float:
    """Read the time of a frame in seconds.

    Raises:
        FrameError: it is no number.
    """
    try:
        return float(t)  # type: ignore[arg-type]
    except Exception as error:  # noqa: BLE001 - as above
        raise FrameError(f"t must be a number of seconds: {error}.") from None


def _copy(numbers: Array, wanted: str) -> npt.NDArray[np.float32]:
    """Copy numbers of any kind; what is too large for single precision becomes infinite.

    Raises:
        FrameError: they are no real numbers, for whatever reason their library has.
    """
    try:
        given = np.asarray(numbers)
        with np.errstate(all="ignore"):
            real = given if np.iscomplexobj(given) else np.array(given, dtype=np.float32)
    except Exception as error:  # noqa: BLE001 - any library's array may be handed over
        raise FrameError(f"{wanted}: {error}.") from None
    if np.iscomplexobj(real):
        raise FrameError(f"{wanted}, got complex ones.")
    return real


def find_flaw(pose: npt.NDArray[np.float32] | None) -> str | None:
    """Tell why the service would refuse these coordinates, None where it would not."""
    if pose is None:
        return None
    largest = np.abs(pose).max(initial=0.0, where=~np.isnan(pose))
    return "bad_frame" if largest > COORDINATE_MAX_M else None


def find_wrong_time(t: float, last_t: float | None, max_rate_hz: float) -> str | None:
    """Tell why a frame at this time cannot be sent, None where it can."""
    if not math.isfinite(t):
        return "bad_time"
    if last_t is None or last_t - t > CLOCK_RESTART_S:
        return None
    if t <= last_t:
        return "t_not_increasing"
    return "too_fast" if (t - last_t) * max_rate_hz < RATE_SLACK else None
