"""Nets and baselines of others, on the same data and windows, before and after a person's trial."""

from collections.abc import Sequence

from models.baselines import Forecaster, Ridge
from models.data.clips import Clip
from models.data.windows import cut_windows
from models.spec import MotionSpec

RIDGE = "ridge"
"""Linear regression, fitted anew for every row; trained on the paper's people alone."""


def make_ridge(training: Sequence[Clip], trial: Sequence[Clip]) -> dict[str, Forecaster]:
    """Fit the ridge and its personal twin in closed form."""
    spec = MotionSpec()
    ridge = Ridge.fit(cut_windows(training, spec), clips=training)
    return {"base": ridge, "plain": ridge.personalize(cut_windows(trial, spec))}
