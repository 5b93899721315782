"""Counters of what happens with every frame, where prometheus_client's own take a microsecond each.

Only one thread writes each of them, so they need no lock; whoever reads them may be a frame behind.
"""

import time
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Sequence
from itertools import accumulate

from prometheus_client import CollectorRegistry
from prometheus_client.metrics_core import CounterMetricFamily, HistogramMetricFamily
from prometheus_client.registry import Collector


class Tally(Collector):
    """How often something happened, by one label.

    Args:
        name, meaning, label: as operators see them.
        registry: where they do.
    """

    def __init__(self, name: str, meaning: str, label: str, *, registry: CollectorRegistry) -> None:
        self._name, self._meaning, self._labelnames = name, meaning, (label,)
        self._counts: defaultdict[str, int] = defaultdict(int)
        self._created = time.time()
        registry.register(self)

    def add(self, value: str, number: int = 1) -> None:
        """Count what happened, under this value of the label."""
        self._counts[value] += number

    def describe(self) -> list[CounterMetricFamily]:
        """Say what this counts."""
        return [CounterMetricFamily(self._name, self._meaning, labels=self._labelnames)]

    def collect(self) -> list[CounterMetricFamily]:
        """Give the counts."""
        (family,) = self.describe()
        for value, count in tuple(self._counts.items()):
            family.add_metric([value], count, created=self._created)
        return [family]


class Spread(Collector):
    """How some amounts are distributed, by one label.

    Args:
        name, meaning, label: as operators see them.
        values: of the label.
        bounds: upper ends of the buckets; one without an end follows.
        registry: where operators see them.
    """

    def __init__(
        self,
        name: str,
        meaning: str,
        label: str,
        *,
        values: Sequence[str],
        bounds: Sequence[int],
        registry: CollectorRegistry,
    ) -> None:
        self._name, self._meaning, self._labelnames = name, meaning, (label,)
        self._bounds = tuple(map(float, bounds))
        self._counts = {value: [0] * (len(bounds) + 1) for value in values}
        self._sums = dict.fromkeys(values, 0.0)
        registry.register(self)

    def observe(self, value: str, amount: float) -> None:
        """Take one amount, under this value of the label."""
        self._counts[value][bisect_left(self._bounds, amount)] += 1
        self._sums[value] += amount

    def describe(self) -> list[HistogramMetricFamily]:
        """Say what this measures."""
        return [HistogramMetricFamily(self._name, self._meaning, labels=self._labelnames)]

    def collect(self) -> list[HistogramMetricFamily]:
        """Give the distributions."""
        (family,) = self.describe()
        ends = [*map(str, self._bounds), "+Inf"]
        for value, counts in self._counts.items():
            buckets = list(zip(ends, accumulate(counts), strict=True))
            family.add_metric([value], buckets, self._sums[value])
        return [family]
