"""How old a frame is, from two clocks that know nothing of each other."""

import math

_SLEW = 0.1
_STEP_MAX_S = 0.1
_FAR_S = 5.0
_LATE_S = 0.5
"""A pong after this long says too little: its program stood still, or its link stalled."""
_RTT_FORGET = 1.02


class ClientClock:
    """The difference between the server's clock and that of a client's frames.

    Two estimates. Pongs bound the difference from both sides, to half of the round trip. Without
    them, the quickest frame so far counts as not delayed at all; that estimate may follow a clock
    that runs slower than ours by 10 %, but only while frames come, so that it does not take the
    backlog of a stalled link for fresh.
    """

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Forget everything: the client's clock is a new one."""
        self._quickest: float | None = None
        self._last_now = 0.0
        self._ponged: float | None = None
        self._rtt = float("inf")

    def observe(self, t: float, now: float) -> float:
        """Take the time of a frame and give its age in milliseconds.

        Args:
            t: capture time on the client's clock, seconds.
            now: the server's monotonic clock, seconds.
        """
        delay = now - t
        if self._quickest is None:
            self._quickest = delay
        else:
            drift = _SLEW * min(now - self._last_now, _STEP_MAX_S)
            self._quickest = min(delay, self._quickest + drift)
        self._last_now = now
        offset = self._quickest
        if self._ponged is not None and -self._rtt <= offset - self._ponged <= _FAR_S:
            offset = self._ponged  # else the pongs came from another clock than the frames
        return max(0.0, (now - t - offset) * 1e3)

    def pong(self, *, server_t: float, t: float, now: float) -> None:
        """Learn from a pong: sent by us at `server_t`, answered at the client's `t`."""
        rtt = now - server_t
        if not (0 <= rtt <= _LATE_S and math.isfinite(t)):
            return
        self._rtt *= _RTT_FORGET
        if rtt <= self._rtt:
            self._rtt = rtt
            self._ponged = (server_t + now) / 2 - t
