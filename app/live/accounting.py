"""No frame may vanish: what was asked, what was skipped, and how much is too much."""

from collections import deque
from typing import NamedTuple


class Pending(NamedTuple):
    """A frame whose forecast is on its way."""

    seq: int
    t: float
    since: float


class Counts(NamedTuple):
    """What happened between two forecasts."""

    skipped: int
    not_due: int


class Ledger:
    """The frames of a stream that are neither answered nor covered by a message yet."""

    def __init__(self) -> None:
        self._pending: deque[Pending] = deque()
        self._not_due = 0
        self._forgotten = 0

    def __len__(self) -> int:
        return len(self._pending)

    def ask(self, seq: int, t: float, now: float) -> None:
        """Note that a forecast was asked for."""
        self._pending.append(Pending(seq, t, now))

    def pass_over(self) -> None:
        """Note a frame for which no forecast is due."""
        self._not_due += 1

    def settle(self, seq: int) -> Counts | None:
        """Note that the forecast of `seq` goes out; None if it was accounted for before.

        Older frames that still wait were superseded: forecasts leave in the order of their frames.
        """
        if not self._discard_from(seq):
            return None
        skipped, self._forgotten = self._forgotten, 0
        while self._pending and self._pending[0].seq < seq:
            self._pending.popleft()
            skipped += 1
        counts = Counts(skipped, self._not_due)
        self._not_due = 0
        return counts

    def is_newest(self, seq: int) -> bool:
        """Tell whether `seq` still waits, and nothing newer does."""
        return bool(self._pending) and self._pending[-1].seq == seq

    def drop(self, seq: int) -> bool:
        """Note that `seq` was answered by an error; tells whether it was still open."""
        return self._discard_from(seq)

    def forget(self) -> None:
        """Give up everything that was asked; the next forecast counts it as skipped."""
        self._forgotten += len(self._pending)
        self._pending.clear()

    def cover(self, *, asked_before: float) -> Pending | None:
        """Give up what was asked too long ago; gives the newest of it, to be named in a message."""
        newest = None
        while self._pending and self._pending[0].since < asked_before:
            newest = self._pending.popleft()
        return newest

    def _discard_from(self, seq: int) -> bool:
        for entry in self._pending:
            if entry.seq == seq:
                self._pending.remove(entry)
                return True
        return False


class RateLimit:
    """A bucket of tokens: a rate that may be exceeded for a moment, but not kept up."""

    def __init__(self, *, rate_hz: float, burst: float) -> None:
        self._rate_hz, self._burst = rate_hz, burst
        self._tokens = burst
        self._last: float | None = None

    def take(self, now: float) -> bool:
        """Take one token; tells whether there was one."""
        if self._last is not None:
            self._tokens = min(self._burst, self._tokens + (now - self._last) * self._rate_hz)
        self._last = now
        if self._tokens < 1:
            return False
        self._tokens -= 1
        return True


class ErrorBudget:
    """How many mistakes a client may make in a while."""

    def __init__(self, *, most: int, within_s: float) -> None:
        self._times: deque[float] = deque(maxlen=most + 1)
        self._most, self._within_s = most, within_s

    def spend(self, now: float) -> bool:
        """Note a mistake; tells whether there are still few enough."""
        self._times.append(now)
        return len(self._times) <= self._most or now - self._times[0] > self._within_s
