"""How fast may be sent, so that the service does not close the stream as too fast."""

SLACK = 1.05
"""The service reads a tenth more than it says; frames at the full rate need room for pings."""


class Pace:
    """A bucket of messages: one second's worth at once, then the rate and a little more.

    Args:
        rate_hz: messages a second in the long run.
    """

    def __init__(self, rate_hz: float) -> None:
        self.rate_hz = rate_hz
        self._room = max(1.0, rate_hz)
        self._last: float | None = None

    def has_room(self, now: float) -> bool:
        """Tell whether a message may be sent now (seconds)."""
        if self._last is not None:
            refill = max(0.0, now - self._last) * self.rate_hz * SLACK
            self._room = min(max(1.0, self.rate_hz), self._room + refill)
        self._last = now
        return self._room >= 1.0

    def spend(self) -> None:
        """Note that a message is sent."""
        self._room -= 1.0
