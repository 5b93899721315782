"""Is a forecast one of ours? What does not fit is never handed out."""

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple, cast

import numpy as np
import numpy.typing as npt

from kinecast_client.clock import Moment
from kinecast_client.forecasts import Forecast, Severity
from kinecast_client.messages import Hello, Wire, WireForecast

_REMEMBERED = 1024
_TIME_SLACK_S = 1e-5
_SEVERITIES = frozenset({"info", "degraded", "unsafe"})

Flaw = Literal["malformed", "mismatched", "late"]


class Sent(NamedTuple):
    """A frame that was sent on this connection.

    Attributes:
        t: its time on the clock of the frames, seconds.
        offered_at: when it was handed over, on the monotonic clock, seconds.
    """

    t: float
    offered_at: float


class Questions:
    """The frames of this connection that may be answered."""

    def __init__(self) -> None:
        self._sent: OrderedDict[int, Sent] = OrderedDict()

    def note(self, seq: int, sent: Sent) -> None:
        """Note that a frame left."""
        self._sent[seq] = sent
        if len(self._sent) > _REMEMBERED:
            self._sent.popitem(last=False)

    def find(self, seq: int) -> Sent | None:
        """Give what was sent under a number, None where nothing was."""
        return self._sent.get(seq)

    def forget(self) -> None:
        """Take no answer to what was sent until now."""
        self._sent.clear()


@dataclass(slots=True)
class Held:
    """A forecast that was accepted, and what its age is reckoned from."""

    forecast: Forecast
    sent: Sent
    received_at: float

    def find_age(self, now: Moment) -> float:
        """Give its age in seconds."""
        return find_age(self.sent, now)


def find_age(sent: Sent, now: Moment) -> float:
    """Give the age of a frame in seconds: never less than the time since it was handed over.

    So a clock of the frames that is ahead of ours cannot make anything look fresh.
    """
    return max(now.frame - sent.t, now.mono - sent.offered_at)


def read_forecast(
    wire: Wire,
    message: WireForecast,
    hello: Hello,
    sent: Sent,
    *,
    read_now: Callable[[], Moment],
) -> Forecast | Flaw:
    """Read a forecast, if it is one for this frame and this skeleton."""
    try:
        frames = wire.read_array(message.frames, "<f4")
        times = wire.read_array(message.t_out, "<f8")
        radius = wire.read_array(message.radius, "<f4")
    except ValueError:
        return "malformed"
    if frames is None or times is None:
        return "malformed"
    horizon, joints = hello.horizon, len(hello.joints)
    due = sent.t + np.arange(1, horizon + 1) / hello.rate_hz
    fits = (
        message.t == sent.t
        and frames.size == horizon * joints * 3
        and (radius is None or radius.size == horizon * joints)
        and times.size == horizon
        and np.allclose(times, due, rtol=0.0, atol=_TIME_SLACK_S)
    )
    if not fits:
        return "mismatched"
    if not np.isfinite(frames).all() or not _is_distance(radius):
        return "malformed"
    severity = message.severity if message.severity in _SEVERITIES else "unsafe"
    return Forecast(
        frames=frames.reshape(horizon, joints, 3),
        t=times,
        radius=None if radius is None else radius.reshape(horizon, joints),
        coverage=message.coverage,
        version=message.version,
        quality=message.quality,
        severity=cast("Severity", severity),
        filled=message.filled,
        timing=message.timing,
        t_observed=sent.t,
        joints=hello.joints,
        seq=message.seq,
        skipped=message.skipped,
        not_due=message.not_due,
        server_age_ms=message.age_ms,
        _age=lambda: find_age(sent, read_now()),
    )


def _is_distance(radius: npt.NDArray[np.float32] | None) -> bool:
    return radius is None or bool(np.isfinite(radius).all() and (radius >= 0).all())
