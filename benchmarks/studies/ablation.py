"""What each part brings: bases without it, by themselves and fitted to a person whom none saw."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from app.personalize.judge import BLEND
from app.personalize.trainer import learn_rest
from benchmarks.studies.bases import (
    FULL_ABLATION,
    LEFT_OUT_OF_ABLATIONS,
    list_recipes,
    load_net,
)
from benchmarks.studies.cache import Row
from benchmarks.studies.measured import LAST, Measured, measure
from benchmarks.studies.personal import make_plain
from benchmarks.studies.recordings import read_person
from benchmarks.studies.study import Lab, Options, Study, Unit
from benchmarks.studies.tables import Table, tell_ratio
from benchmarks.studies.thaw import GatedNet, blend_nets, thaw
from models.baselines import Forecaster
from models.data.clips import Clip
from models.data.splits import PERSONAL_TRIAL, TEST_TRIALS
from models.metrics import FRAMES
from models.predictor import Predictor
from models.training.bootstrap import bootstrap_ratios
from models.training.finetune import FinetuneConfig, blend

EVERY_PART = "every part"
METHODS = {"base": "base", "plain": "fitted", "gated": f"fitted, {BLEND:.0%} and gated"}
THAWED_RATES = (3e-3, 1e-3, 3e-4)
"""Peaks of the rate for fits of the whole net; the first one is that of a decoder's fit."""


def plan(_: Options) -> list[Unit]:
    """List a unit for each base, and for fits of the whole net."""
    person = LEFT_OUT_OF_ABLATIONS
    full = Unit(EVERY_PART, FULL_ABLATION, person, seconds=40.0)
    thawed = [
        Unit(
            f"whole net fitted, rate {rate:g}",
            FULL_ABLATION,
            person,
            {"thaw_rate": rate},
            seconds=60.0,
        )
        for rate in THAWED_RATES
    ]
    names = [name for name in list_recipes() if name.startswith("ablation-no-")]
    return [full, *thawed, *(Unit(name, name, person, seconds=40.0) for name in names)]


def compute(unit: Unit, lab: Lab) -> dict[str, Any]:
    """Fit to trial 1 and measure on the others."""
    net = load_net(lab.read_base(unit.base))
    trial = read_person(lab.place, unit.person, PERSONAL_TRIAL)
    rate = unit.settings.get("thaw_rate")
    fits = _fit_decoder(net, trial) if rate is None else _fit_whole(net, trial, rate)
    test = read_person(lab.place, unit.person, *TEST_TRIALS)
    return {"errors": measure({"base": net, **fits}, test).as_json()}


def _fit_decoder(net: Predictor, trial: Sequence[Clip]) -> dict[str, Forecaster]:
    plain = make_plain(net, trial)
    gated = learn_rest(net, blend(net.decoder, plain.decoder, BLEND), trial)
    return {"plain": plain, "gated": gated}


def _fit_whole(net: Predictor, trial: Sequence[Clip], rate: float) -> dict[str, Forecaster]:
    fitted = thaw(net, trial, replace(FinetuneConfig(), learning_rate=rate))
    rest = learn_rest(net, net.decoder, trial)
    return {"plain": fitted, "gated": GatedNet(rest, blend_nets(net, fitted, BLEND))}


def tell(row: Row) -> str:
    """Write a row in a line."""
    found = Measured.from_json(row["errors"])
    errors = [f"{name} {found.cm2(method)[-1]:.2f}" for method, name in METHODS.items()]
    return f"cm² at frame {LAST}: {', '.join(errors)}"


def summarise(rows: Sequence[Row]) -> list[Table]:
    """Divide each row's errors by those with every part."""
    full = [Measured.from_json(row["errors"]) for row in rows if row["unit"] == EVERY_PART]
    errors = Table(
        f"cm² at frame {LAST} on {LEFT_OUT_OF_ABLATIONS}, fitted to trial 1, tested on 2 to 4",
        ("", *METHODS.values()),
        [
            (
                row["unit"],
                *(f"{Measured.from_json(row['errors']).cm2(m)[-1]:.2f}" for m in METHODS),
            )
            for row in rows
        ],
    )
    if not full:
        return [errors]
    return [_divide(rows, full[0]), _divide_means(rows, full[0]), errors]


def _divide(rows: Sequence[Row], full: Measured) -> Table:
    title = f"Error ÷ that with every part at frame {LAST}, with a bootstrap over clips"
    lines = [(unit, *map(tell_ratio, ratios)) for unit, ratios in _compare(rows, full, LAST)]
    return Table(title, ("", *METHODS.values()), lines)


def _divide_means(rows: Sequence[Row], full: Measured) -> Table:
    """Frame 2 by itself and the mean over the table's frames, which weigh early frames more."""
    lines = []
    for row in rows:
        found = Measured.from_json(row["errors"])
        values: list[str] = []
        for method in METHODS:
            ratios = np.divide(found.cm2(method), full.cm2(method))
            values += [f"{ratios[0]:.3f}", f"{ratios.mean():.3f}"]
        lines.append((row["unit"], *values))
    heads = (
        f"{name}, {part}" for name in METHODS.values() for part in (f"frame {FRAMES[0]}", "mean")
    )
    return Table("Error ÷ that with every part", ("", *heads), lines)


def _compare(rows: Sequence[Row], full: Measured, frame: int) -> Iterator[tuple[str, list[Any]]]:
    for row in rows:
        found = Measured.from_json(row["errors"])
        ratios = [bootstrap_ratios(found.sums[m], full.sums[m])[frame] for m in METHODS]
        yield row["unit"], ratios


STUDY = Study("ablation", "What does each part bring?", 1, plan, compute, tell, summarise)
