"""Passes over personal decoders that fail again and again, for a while."""

import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

from app.domain.motion import Fallback

TRIP_AFTER = 5
"""Forecasts in a row that have to fail."""
OPEN_S = 10.0
"""How long a decoder is passed over before it is tried again."""
_KEPT = 1024


@dataclass(slots=True)
class _Trouble:
    """What is wrong with a decoder.

    Attributes:
        count: forecasts that failed in a row.
        reason: how the last one failed.
        until: when it is tried again.
    """

    count: int
    reason: Fallback
    until: float = 0.0


class Breaker:
    """Which decoders are not worth a try at the moment.

    The engine's thread reports to it; any thread may ask. The base is not in it: it is everybody's,
    and one person's odd input must not take it from the others.

    Args:
        clock: monotonic, seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._troubles: OrderedDict[str, _Trouble] = OrderedDict()

    def blocks(self, sha256: str | None) -> Fallback | None:
        """Tell how a decoder keeps failing, None where it may be tried."""
        trouble = None if sha256 is None else self._troubles.get(sha256)
        if trouble is None or self._clock() >= trouble.until:
            return None
        return trouble.reason

    def is_failing(self, sha256: str) -> bool:
        """Tell whether a decoder has been passed over and has not answered since."""
        trouble = self._troubles.get(sha256)
        return trouble is not None and trouble.until > 0

    def succeed(self, sha256: str) -> None:
        """Take note of a good forecast."""
        if sha256 in self._troubles:
            self._troubles.pop(sha256, None)

    def fail(self, sha256: str, reason: Fallback) -> bool:
        """Take note of a bad forecast; tells whether the decoder is passed over from now on."""
        trouble = self._troubles.pop(sha256, None) or _Trouble(0, reason)
        trouble.count, trouble.reason = trouble.count + 1, reason
        now = self._clock()
        trips = trouble.count >= TRIP_AFTER and now >= trouble.until
        if trips:
            trouble.until = now + OPEN_S
        self._troubles[sha256] = trouble
        while len(self._troubles) > _KEPT:
            self._troubles.popitem(last=False)
        return trips
