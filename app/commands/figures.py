"""Figures out of many measurements."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

import numpy as np
from jaxtyping import Float64


@dataclass(frozen=True, slots=True)
class Spread:
    """What is told of a set of measurements, in their unit."""

    median: float
    p99: float
    p999: float
    most: float
    count: int

    def as_json(self) -> dict[str, Any]:
        """Give the figures as the commands write them; null where there are none."""
        values = {"p50": self.median, "p99": self.p99, "p99_9": self.p999, "max": self.most}
        told = {
            name: None if math.isnan(value) else round(value, 3) for name, value in values.items()
        }
        return {**told, "count": self.count}


def summarize(values: Sequence[float] | Float64[np.ndarray, " value"]) -> Spread:
    """Give median, tail and maximum; NaN for nothing."""
    if not len(values):
        return Spread(float("nan"), float("nan"), float("nan"), float("nan"), 0)
    median, p99, p999 = np.percentile(np.asarray(values, dtype=np.float64), (50, 99, 99.9))
    return Spread(float(median), float(p99), float(p999), float(np.max(values)), len(values))


def take_median(values: Sequence[float | None]) -> float | None:
    """Give the median of the figures that there are; None for none."""
    known = [value for value in values if value is not None]
    return median(known) if known else None
