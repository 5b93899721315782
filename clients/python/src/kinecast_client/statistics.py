"""How a stream has fared: counts, and how long things took."""

from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

_KEPT = 4096
"""Of this many of the newest values percentiles are given: over two minutes at 30 Hz."""


@dataclass(frozen=True, slots=True)
class Spread:
    """How values are spread, in milliseconds; NaN where there are none.

    Attributes:
        p50: half of them are at most this.
        p90: nine in ten are.
        p99: 99 in a hundred are.
        worst: all are.
        count: how many there are.
    """

    p50: float
    p90: float
    p99: float
    worst: float
    count: int


@dataclass(frozen=True, slots=True)
class Statistics:
    """How a stream has fared since it was made; times are of the newest 4096 forecasts.

    Attributes:
        age: from the capture of a frame to its forecast in our hands, by our clock.
        response: from `send` to the forecast in our hands: what network and service take.
        service: of which in the service.
        round_trip: of pings.
        offered: frames that `send` took.
        refused: frames that `send` did not take, by reason.
        sent: frames that left, those sent again included.
        unsent: frames that never left, because newer ones had come meanwhile.
        forecasts: forecasts that could be used when they came.
        late: forecasts that were too old when they came; never handed out.
        mismatched: forecasts that do not fit to what was sent; never handed out.
        skipped: frames that the service passed over for a newer one.
        not_due: frames for which no forecast was asked (`forecast_every`).
        malformed: messages that could not be read.
        errors: errors that the service told of, by code.
        reconnects: connections that were opened after the first.
        unrecorded: frames that a recording lost, because the service was away for too long.
        callback_errors: exceptions of callbacks, which never stop a stream.
    """

    age: Spread
    response: Spread
    service: Spread
    round_trip: Spread
    offered: int
    refused: Mapping[str, int]
    sent: int
    unsent: int
    forecasts: int
    late: int
    mismatched: int
    skipped: int
    not_due: int
    malformed: int
    errors: Mapping[str, int]
    reconnects: int
    unrecorded: int
    callback_errors: int


class Tally:
    """Counts while a stream runs."""

    def __init__(self) -> None:
        self.age_ms = _new_row()
        self.response_ms = _new_row()
        self.service_ms = _new_row()
        self.round_trip_ms = _new_row()
        self.offered = self.sent = self.forecasts = self.late = self.mismatched = 0
        self.skipped = self.not_due = self.malformed = self.connections = self.callback_errors = 0
        self.refused: Counter[str] = Counter()
        self.errors: Counter[str] = Counter()

    def sum_up(self, *, unsent: int, unrecorded: int) -> Statistics:
        """Give the figures as of now."""
        return Statistics(
            age=_spread(self.age_ms),
            response=_spread(self.response_ms),
            service=_spread(self.service_ms),
            round_trip=_spread(self.round_trip_ms),
            offered=self.offered,
            refused=MappingProxyType(dict(self.refused)),
            sent=self.sent,
            unsent=unsent,
            forecasts=self.forecasts,
            late=self.late,
            mismatched=self.mismatched,
            skipped=self.skipped,
            not_due=self.not_due,
            malformed=self.malformed,
            errors=MappingProxyType(dict(self.errors)),
            reconnects=max(0, self.connections - 1),
            unrecorded=unrecorded,
            callback_errors=self.callback_errors,
        )


def _new_row() -> deque[float]:
    return deque(maxlen=_KEPT)


def _spread(row: deque[float]) -> Spread:
    if not row:
        nothing = float("nan")
        return Spread(nothing, nothing, nothing, nothing, 0)
    p50, p90, p99, worst = np.percentile(np.array(row), (50, 90, 99, 100)).tolist()
    return Spread(p50, p90, p99, worst, len(row))
