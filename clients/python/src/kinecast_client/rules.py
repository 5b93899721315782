"""Every number by which a stream decides something."""

import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Rules:
    """When a stream takes something for too old, dead or worth another try.

    Attributes:
        max_age_s: a forecast whose newest frame is older than this is never handed out.
        hold_s: a forecast counts for this long after it came; then there is none.
        silence_s: a connection that leaves us without an answer for this long is dead.
        open_s: longest wait for a connection and its hello.
        ping_every_s: how often the clocks are compared.
        retry_first_s: first wait before another try, doubled with each failure.
        retry_most_s: longest wait.
        settled_s: a connection that lasted this long was a good one.
    """

    max_age_s: float = 0.2
    hold_s: float = 0.15
    silence_s: float = 2.0
    open_s: float = 5.0
    ping_every_s: float = 5.0
    retry_first_s: float = 0.1
    retry_most_s: float = 5.0
    settled_s: float = 5.0

    def find_delay(self, failures: int, draw: float) -> float:
        """Give the wait after a number of failures in a row, with jitter.

        Args:
            failures: 1 for the first.
            draw: a random number from 0 to 1.
        """
        doublings = min(max(failures, 1) - 1, 32)
        most = min(self.retry_most_s, self.retry_first_s * math.ldexp(1.0, doublings))
        return most * (0.5 + 0.5 * draw)
