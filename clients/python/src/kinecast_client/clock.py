"""What is known of time: ours, and the service's."""

import math
from typing import NamedTuple

_RTT_FORGET = 1.02
"""A round trip counts as better than the best one so far if it is at most this much longer for
each one since: clocks drift."""
LATE_PING_S = 0.1
STEP_S = 0.02
"""The clock of the frames was set anew if it differs by this much from ours within a round trip."""


class Moment(NamedTuple):
    """A point in time.

    Attributes:
        mono: this machine's monotonic clock, seconds: for deadlines.
        frame: the clock of the frames, seconds; the same one unless the caller has another.
    """

    mono: float
    frame: float


class ServerClock:
    """The service's clock against that of our frames, from pings and pongs.

    Attributes:
        offset_s: the service's clock minus ours, exact to half of `rtt_s`; None before a pong.
        rtt_s: the round trip by which it was measured, None before a pong.
    """

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Forget everything: the clock of the frames is a new one."""
        self.offset_s: float | None = None
        self.rtt_s: float | None = None
        self._best = math.inf

    def learn(self, *, sent: Moment, server_t: float, now: Moment) -> float | None:
        """Learn from a pong and give its round trip in seconds, None where it makes no sense."""
        rtt_s = now.mono - sent.mono
        has_stepped = abs(now.frame - sent.frame - rtt_s) > STEP_S
        if rtt_s < 0 or has_stepped or not math.isfinite(server_t):
            return None
        self._best *= _RTT_FORGET
        if rtt_s <= self._best:
            self._best = self.rtt_s = rtt_s
            self.offset_s = server_t - (sent.frame + now.frame) / 2
        return rtt_s

    def is_late(self, server_t: float, now: Moment) -> bool:
        """Tell whether what the service sent at `server_t` by its clock took too long to us.

        A pong to such a ping would mislead the service by half of that: it could take fresh frames
        for stale. False where the clocks have not been compared yet.
        """
        if self.offset_s is None:
            return False
        return now.frame + self.offset_s - server_t > LATE_PING_S
