"""A calibrated radius per joint and frame.

The table holds, for each level, the empirical quantile of the distance between the forecast and the
true joint on people whom the calibrated net had never seen. It says nothing about this window in
particular, and nothing at all about a person or a sensor unlike those it was measured on.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Float32

LEVELS = (0.5, 0.6, 0.7, 0.8, 0.85, 0.9, 0.95, 0.975, 0.99)
_SMALLEST_M = 1e-4


@dataclass(frozen=True, slots=True)
class RadiusTable:
    """Quantiles of the joint error in metres.

    Attributes:
        table: metres; rises along the levels.
        levels: coverage of each row.
        calibrated_on: who the errors were measured on.
    """

    table: Float32[np.ndarray, "level horizon joint"]
    levels: tuple[float, ...] = LEVELS
    calibrated_on: str = ""

    def __post_init__(self) -> None:
        """Refuse a table that does not fit its levels or does not rise along them."""
        if len(self.levels) != len(self.table):
            raise ValueError(f"{len(self.levels)} levels, but a table of {len(self.table)}")
        if not np.all(np.isfinite(self.table)) or np.any(np.diff(self.table, axis=0) < 0):
            raise ValueError("radii must be finite and must not fall as the coverage rises")

    def radius(self, coverage: float) -> Float32[np.ndarray, "horizon joint"]:
        """Radius in metres within which the true joint lies with this probability.

        Linear between the levels; below the lowest it shrinks towards 0 at coverage 0.

        Raises:
            ValueError: coverage outside (0, highest level].
        """
        if not 0 < coverage <= self.levels[-1]:
            raise ValueError(
                f"coverage must be above 0 and at most {self.levels[-1]}, got {coverage}"
            )
        levels = np.array([0.0, *self.levels])
        table = np.concatenate([np.zeros_like(self.table[:1]), self.table])
        above = min(int(np.searchsorted(levels, coverage)), len(levels) - 1)
        share = (coverage - levels[above - 1]) / (levels[above] - levels[above - 1])
        mixed = table[above - 1] + share * (table[above] - table[above - 1])
        return np.asarray(mixed, dtype=np.float32)

    def describe(self) -> dict[str, Any]:
        """Say what goes into a checkpoint's metadata beside the table."""
        return {"levels": list(self.levels), "calibrated_on": self.calibrated_on}

    @classmethod
    def restore(cls, table: np.ndarray, described: dict[str, Any]) -> "RadiusTable":
        """Rebuild a table from a checkpoint."""
        return cls(table, tuple(described["levels"]), described["calibrated_on"])

    @classmethod
    def calibrate(
        cls, distances: Float32[np.ndarray, "windows horizon joint"], *, calibrated_on: str
    ) -> "RadiusTable":
        """Take the quantiles of held-out distances (metres)."""
        quantiles = np.quantile(distances, LEVELS, axis=0).astype(np.float32)
        return cls(np.maximum.accumulate(quantiles, axis=0), LEVELS, calibrated_on)


def coverage_of(
    distances: Float32[np.ndarray, "windows horizon joint"],
    radius: Float32[np.ndarray, "horizon joint"],
) -> float:
    """Share of joints that truly lie within the radius."""
    return float(np.mean(distances <= radius))


def fit_scale(
    table: RadiusTable | None,
    distances: Sequence[Float[np.ndarray, "_ horizon joint"]],
    *,
    coverage: float = 0.9,
) -> float | None:
    """Give the factor that makes a table hold for one person's held-out distances (metres).

    The quantile of distance ÷ radius is the factor by which the radius has to change (split
    conformal prediction, Lei et al. 2018). It is kept between a half and twice the table.

    Args:
        table: of the base, None where it has none.
        distances: between forecasts and what happened, of windows that were not trained on.
        coverage: at which the factor is to be right.

    Returns:
        None without a table or without distances.
    """
    parts = [part for part in distances if len(part)]
    if table is None or not parts:
        return None
    radius = np.maximum(table.radius(coverage), _SMALLEST_M)
    return float(np.clip(np.quantile(np.concatenate(parts) / radius, coverage), 0.5, 2.0))
