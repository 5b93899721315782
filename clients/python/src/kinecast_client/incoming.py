"""Is a forecast one of ours? What does not fit is never handed out."""

import math
from collections import OrderedDict
from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np

from kinecast_client.clock import Moment
from kinecast_client.forecasts import Forecast, is_distance, read_severity
from kinecast_client.messages import Hello, Wire, WireForecast
from kinecast_client.rules import Rules
from kinecast_client.statistics import Tally

_REMEMBERED = 1024
_TIME_SLACK_S = 1e-5

Flaw = Literal["malformed", "mismatched"]


class Sent(NamedTuple):
    """A frame that was sent on this connection.

    Attributes:
        t: its time on the clock of the frames, seconds.
        offered_at: when it was handed over, on the monotonic clock, seconds.
    """

    t: float
    offered_at: float


class Held(NamedTuple):
    """A forecast that was accepted, and what its age is reckoned from."""

    forecast: Forecast
    seq: int
    sent: Sent
    received_at: float


class Incoming:
    """What was asked on this connection, and the newest answer that may be used.

    Args:
        wire: the subprotocol.
        rules: when a forecast is too old.
        tally: where to count.
        read_now: both clocks, for the age of forecasts in the hands of the caller only.

    Attributes:
        generation: how many forecasts were accepted.
    """

    def __init__(
        self, wire: Wire, rules: Rules, tally: Tally, *, read_now: Callable[[], Moment]
    ) -> None:
        self.generation = 0
        self._wire, self._rules, self._tally, self._read_now = wire, rules, tally, read_now
        self._asked: OrderedDict[int, Sent] = OrderedDict()
        self._held: Held | None = None
        self._answered_seq = -1

    def ask(self, seq: int, sent: Sent) -> None:
        """Note that a frame left which may be answered."""
        self._asked[seq] = sent
        if len(self._asked) > _REMEMBERED:
            self._asked.popitem(last=False)

    def forget_questions(self) -> None:
        """Take no answer any more to what was sent until now."""
        self._asked.clear()

    def forget_answer(self) -> None:
        """Hand out nothing any more of what came until now."""
        self._held = None

    def take(self, message: WireForecast, hello: Hello, *, floor: int, now: Moment) -> bool:
        """Keep a forecast if it may be used, and tell whether it may; count it in any case.

        `floor` is the lowest number of a frame whose forecast is still wanted.
        """
        sent = self._asked.get(message.seq)
        if sent is None:
            self._tally.mismatched += 1
            return False
        outcome = read_forecast(self._wire, message, hello, sent, read_now=self._read_now)
        if outcome == "malformed":
            self._tally.malformed += 1
        elif outcome == "mismatched":
            self._tally.mismatched += 1
        elif message.seq < max(floor, self._answered_seq + 1) or self._is_old(sent, now):
            self._tally.late += 1
        else:
            self._hold(outcome, message.seq, sent, now)
            return True
        return False

    def latest(self, *, floor: int, now: Moment) -> Forecast | None:
        """Give the newest forecast that may be used now, None where there is none."""
        held = self._held
        if held is None or held.seq < floor or now.mono - held.received_at > self._rules.hold_s:
            return None
        return None if self._is_old(held.sent, now) else held.forecast

    def _is_old(self, sent: Sent, now: Moment) -> bool:
        return find_age(sent, now) > self._rules.max_age_s

    def _hold(self, forecast: Forecast, seq: int, sent: Sent, now: Moment) -> None:
        self._held, self._answered_seq = Held(forecast, seq, sent, now.mono), seq
        self.generation += 1
        tally = self._tally
        tally.forecasts += 1
        tally.skipped += max(0, forecast.skipped)
        tally.not_due += max(0, forecast.not_due)
        tally.age_ms.append(find_age(sent, now) * 1e3)
        tally.response_ms.append((now.mono - sent.offered_at) * 1e3)
        tally.service_ms.append(forecast.timing.total_ms)


def find_age(sent: Sent, now: Moment) -> float:
    """Give the age of a frame in seconds: never less than the time since it was handed over.

    So a clock of the frames that is ahead of ours cannot make anything look fresh. Where that clock
    gives no number, nothing is fresh.
    """
    age = now.frame - sent.t
    return math.inf if math.isnan(age) else max(age, now.mono - sent.offered_at)


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
    if not np.isfinite(frames).all() or not is_distance(radius):
        return "malformed"
    return Forecast(
        frames=frames.reshape(horizon, joints, 3),
        t=times,
        radius=None if radius is None else radius.reshape(horizon, joints),
        coverage=message.coverage,
        version=message.version,
        quality=message.quality,
        severity=read_severity(message.severity),
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
