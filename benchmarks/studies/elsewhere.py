"""The peers as another implementation has them, by the same protocol: is our own peer weak?

siMLPe of 48 layers after 65 epochs and a ridge on the window, both trained on subjects 1, 3, 5 and
7 of UTD-MHAD alone, before and after trial 1: all of siMLPe fine-tuned, the ridge in closed form.
Measured once on the same recordings, outside of this repository; no command here prints them again.
"""

from collections.abc import Mapping

import numpy as np

from benchmarks.studies.measured import Measured, divide_by
from benchmarks.studies.tables import Table
from models.metrics import FRAMES

ELSEWHERE: dict[str, dict[str, tuple[float, ...]]] = {
    "siMLPe": {
        "2": (5.52, 11.88, 26.40, 32.57, 39.56, 42.90),
        "4": (5.65, 12.16, 26.92, 33.12, 40.23, 43.88),
        "6": (4.77, 10.50, 24.44, 31.20, 40.15, 45.23),
    },
    "siMLPe, personal": {
        "2": (5.42, 10.74, 21.08, 24.75, 28.87, 31.12),
        "4": (5.42, 11.11, 22.65, 27.15, 32.31, 35.17),
        "6": (4.84, 9.74, 20.07, 24.64, 30.56, 34.19),
    },
    "ridge": {
        "2": (5.60, 13.62, 33.07, 41.57, 51.53, 56.41),
        "4": (6.05, 15.01, 35.01, 42.60, 50.51, 54.05),
        "6": (5.10, 12.81, 32.63, 41.87, 53.53, 59.95),
    },
    "ridge, personal": {
        "2": (5.31, 12.25, 27.65, 34.01, 41.26, 44.67),
        "4": (5.63, 13.51, 30.70, 37.33, 44.32, 47.41),
        "6": (4.65, 11.14, 27.20, 34.64, 43.93, 48.98),
    },
}
"""cm², mean over frames 1..k, by method and subject, at the frames of the table."""
_FROM = FRAMES.index(4)
COMPARED = (
    ("shipped", "base", "siMLPe"),
    ("shipped", "served", "siMLPe, personal"),
    ("paper", "base", "siMLPe"),
    ("paper", "served", "siMLPe, personal"),
    ("paper", "base", "ridge"),
    ("paper", "served", "ridge, personal"),
    ("simlpe-paper", "base", "siMLPe"),
    ("simlpe-paper", "plain", "siMLPe, personal"),
    ("ridge", "base", "ridge"),
    ("ridge", "plain", "ridge, personal"),
)
"""Family, method, and what it is divided by: ours first, then our own peers by themselves."""


def compare_elsewhere(
    families: Mapping[str, Mapping[int, Mapping[str, Measured]]], methods: Mapping[str, str]
) -> Table:
    """Compare what is there with the other implementation.

    Args:
        families: what was measured, by family, seed and subject.
        methods: what to call a method.
    """
    lines = []
    for family, method, other in COMPARED:
        if family in families:
            seeds = families[family].values()
            ratios = np.mean([divide_by(one, method, ELSEWHERE[other]) for one in seeds], axis=0)
            later = ratios[:, _FROM:]
            told = (ratios.mean(), later.mean(), later.max(), ratios.max())
            name = f"{family}, {methods[method]}"
            lines.append((name, other, str(len(seeds)), *(f"{value:.3f}" for value in told)))
    columns = (
        "trained on, method",
        "divided by, elsewhere",
        "seeds",
        "mean of 18 cells",
        "from frame 4 on",
        "worst cell from frame 4 on",
        "worst cell",
    )
    return Table("Error ÷ that of the peers in another implementation", columns, lines)
