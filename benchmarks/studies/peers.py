"""Nets and baselines of others, on the same data and windows, before and after a person's trial."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from models.baselines import Forecaster, Ridge
from models.data.clips import Clip
from models.data.windows import cut_windows
from models.spec import MotionSpec
from models.training.loop import Progress
from models.training.simlpe import SimlpeConfig, SimlpeFinetune, personalize_simlpe, train_simlpe
from models.training.simlpe_file import load_simlpe, save_simlpe

RIDGE = "ridge"
"""Linear regression, fitted anew for every row; trained on the paper's people alone."""
SIMLPE = "simlpe"


def make_ridge(training: Sequence[Clip], trial: Sequence[Clip]) -> dict[str, Forecaster]:
    """Fit the ridge and its personal twin in closed form."""
    spec = MotionSpec()
    ridge = Ridge.fit(cut_windows(training, spec), clips=training)
    return {"base": ridge, "plain": ridge.personalize(cut_windows(trial, spec))}


def make_simlpe(path: Path, trial: Sequence[Clip], *, seed: int) -> dict[str, Forecaster]:
    """Load a siMLPe and fine-tune all of it."""
    net = load_simlpe(path).net
    own = personalize_simlpe(net, trial, replace(SimlpeFinetune(), seed=seed))
    return {"base": net, "plain": own}


def describe_simlpe_fit() -> Mapping[str, Any]:
    """Describe everything that decides a personal siMLPe but clips, base and seed."""
    return {"simlpe": asdict(SimlpeFinetune())}


def train_simlpe_file(
    path: Path,
    clips: Sequence[Clip],
    config: SimlpeConfig,
    *,
    about: Mapping[str, Any],
    report: Callable[[Progress], None],
) -> None:
    """Train a siMLPe and write it without times and commits, so that equal nets are equal files."""
    trained = train_simlpe(clips, config, report=report)
    kept = ("training", "data", "data_sha256", "torch")
    metadata = {name: trained.metadata[name] for name in kept}
    save_simlpe(path, trained.net, {**metadata, **about})
