"""The protocol of the paper: base and personal versions on subjects 2, 4 and 6, over seeds."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks.studies.cache import Row
from benchmarks.studies.elsewhere import compare_elsewhere
from benchmarks.studies.measured import LAST, Measured, average, divide_by, join, measure
from benchmarks.studies.peers import RIDGE, SIMLPE, describe_simlpe_fit, make_ridge, make_simlpe
from benchmarks.studies.personal import compare_versions
from benchmarks.studies.recordings import UTD, read_person
from benchmarks.studies.study import Lab, Options, Study, Unit, subject_of
from benchmarks.studies.tables import (
    FRAME_COLUMNS,
    RATIO_COLUMNS,
    Table,
    cells,
    tell_ratios,
    tell_spread,
)
from models.baselines.closed_form import KernelCorrection
from models.checkpoint import load_checkpoint
from models.correction import STRENGTH, WIDTH
from models.data.splits import PERSONAL_TRIAL, TEST_SUBJECTS, TEST_TRIALS
from models.metrics import FRAMES
from models.training.bootstrap import bootstrap_ratios
from models.training.compare import EARLY, LATE, PAPER_AFTER, PAPER_BEFORE
from models.training.evaluate import PUBLISHED

SHIPPED, PAPER = "shipped", "paper"
FAMILIES = (SHIPPED, PAPER)
"""Bases by who trained them: everybody, or the paper's four people."""
CLOSED_FORM = "closed-form"
"""Personal versions of the same bases by a correction in closed form."""
SEEDS = (0, 1, 2)
Seeds = dict[int, dict[str, Measured]]
"""What was measured with bases of a family: by seed and subject."""
METHODS = {
    "base": "base",
    "served": "personal, with judge and gate",
    "plain": "personal, without",
}
PAPER_ROWS = {"base": PAPER_BEFORE, "served": PAPER_AFTER, "plain": PAPER_AFTER}
PAIRS = (
    *(
        ((family, method), (family, reference))
        for family in FAMILIES
        for method, reference in (("served", "base"), ("plain", "base"), ("served", "plain"))
    ),
    ((SHIPPED, "base"), (PAPER, "base")),
    ((SHIPPED, "served"), (PAPER, "served")),
    *(
        ((family, method), (f"{SIMLPE}-{family}", reference))
        for family in FAMILIES
        for method, reference in (("base", "base"), ("served", "plain"), ("plain", "plain"))
    ),
    *(((family, "served"), (f"{CLOSED_FORM}-{family}", "plain")) for family in FAMILIES),
    ((PAPER, "base"), (RIDGE, "base")),
    ((PAPER, "served"), (RIDGE, "plain")),
)
"""What is divided by what, as (family, method)."""


def plan(_: Options) -> list[Unit]:
    """List a unit for each base and subject, and for each peer."""
    units = [
        _unit(family, seed, subject)
        for seed in SEEDS
        for family in FAMILIES
        for subject in TEST_SUBJECTS
    ]
    units += [
        _unit(f"{kind}-{family}", seed, subject)
        for kind in (CLOSED_FORM, SIMLPE)
        for seed in SEEDS
        for family in FAMILIES
        for subject in TEST_SUBJECTS
    ]
    return [*units, *(_unit(RIDGE, 0, subject) for subject in TEST_SUBJECTS)]


def _unit(family: str, seed: int, subject: str) -> Unit:
    name, settings = f"{family}-{seed}", {"seed": seed, "family": family}
    is_peer = family not in FAMILIES
    base = "" if family == RIDGE else name.removeprefix(f"{CLOSED_FORM}-")
    return Unit(
        f"{name}, subject {subject}",
        base,
        f"{UTD}/{subject}",
        settings,
        seconds=25.0 if is_peer else 85.0,
        personal=not is_peer,
        decided_by=_describe_fit(family),
    )


def _describe_fit(family: str) -> Mapping[str, Any]:
    """Describe what decides a peer's personal version but clips, base and seed."""
    if family.startswith(SIMLPE):
        return describe_simlpe_fit()
    return {"kernel": [WIDTH, STRENGTH]} if family.startswith(CLOSED_FORM) else {}


def compute(unit: Unit, lab: Lab) -> dict[str, Any]:
    """Fit to trial 1 and measure on the others."""
    trial = read_person(lab.place, unit.person, PERSONAL_TRIAL)
    test = read_person(lab.place, unit.person, *TEST_TRIALS)
    told: dict[str, Any] = {}
    seed, family = unit.settings["seed"], unit.settings["family"]
    if family.startswith(SIMLPE):
        methods = make_simlpe(lab.find_base(unit.base), trial, seed=seed)
    elif family.startswith(CLOSED_FORM):
        net = load_checkpoint(lab.read_base(unit.base)).predictor
        methods = {"base": net, "plain": KernelCorrection.fit(net, trial)}
    elif family == RIDGE:
        methods = make_ridge(lab.recipes[f"{PAPER}-0"].select(lab.place), trial)
    else:
        methods, told = compare_versions(lab.read_base(unit.base), trial, seed=seed)
    return {**told, "errors": measure(methods, test).as_json()}


def tell(row: Row) -> str:
    """Write a row in a line."""
    found = Measured.from_json(row["errors"])
    errors = [f"{method} {found.cm2(method)[-1]:.2f}" for method in METHODS if method in found.sums]
    return f"{row.get('verdict', 'peer')}, cm² at frame {LAST}: {', '.join(errors)}"


def summarise(rows: Sequence[Row]) -> list[Table]:
    """Compare with the paper's rows, show the table, and compare methods on the same clips."""
    families = {row["family"]: by_seed(rows, row["family"]) for row in rows}
    families = {family: seeds for family, seeds in families.items() if seeds}
    return [
        _compare_with_paper(families),
        _compare_methods(families),
        compare_elsewhere(families, METHODS),
        *(_show_errors(family, list(seeds.values())) for family, seeds in families.items()),
    ]


def by_seed(rows: Sequence[Row], family: str) -> Seeds:
    """Sort a family's rows by seed and subject; seeds that lack a subject are left out."""
    seeds: Seeds = {}
    for row in rows:
        if row["family"] == family:
            found = Measured.from_json(row["errors"])
            seeds.setdefault(row["seed"], {})[subject_of(row)] = found
    return {seed: one for seed, one in seeds.items() if len(one) == len(TEST_SUBJECTS)}


def compare_with_paper(found: Mapping[str, Measured], method: str) -> dict[str, float]:
    """Divide by the paper's rows: mean over the late cells and the early ones, and the worst.

    Args:
        found: by subject.
        method: one of `METHODS`.
    """
    papers = {subject: PUBLISHED[PAPER_ROWS[method], subject] for subject in found}
    ratios = divide_by(found, method, papers)
    late, early = ([FRAMES.index(frame) for frame in chosen] for chosen in (LATE, EARLY))
    return {
        "late": float(ratios[:, late].mean()),
        "early": float(ratios[:, early].mean()),
        "worst": float(ratios.max()),
    }


def pool(seeds: Seeds) -> Measured:
    """Average each clip over seeds, and put the subjects together."""
    return join([average([one[subject] for one in seeds.values()]) for subject in TEST_SUBJECTS])


def _list_methods(found: Measured) -> dict[str, str]:
    return {method: name for method, name in METHODS.items() if method in found.sums}


def _compare_with_paper(families: Mapping[str, Seeds]) -> Table:
    lines = []
    for family, seeds in families.items():
        for method, name in _list_methods(pool(seeds)).items():
            found = [compare_with_paper(one, method) for one in seeds.values()]
            spread = (tell_spread([one[part] for one in found]) for part in found[0])
            lines.append((f"{family}, {name}", PAPER_ROWS[method], str(len(found)), *spread))
    columns = (
        "trained on, method",
        "divided by",
        "seeds",
        f"frames {', '.join(map(str, LATE))}: mean of 12 cells",
        f"frames {', '.join(map(str, EARLY))}: mean of 6 cells",
        "worst cell",
    )
    return Table("Error ÷ the paper's, mean and range over seeds", columns, lines)


def _show_errors(family: str, seeds: Sequence[Mapping[str, Measured]]) -> Table:
    lines = []
    for subject in TEST_SUBJECTS:
        own = [one[subject] for one in seeds]
        for method, name in _list_methods(own[0]).items():
            errors = np.array([one.cm2(method) for one in own])
            lines.append((subject, name, str(len(own)), *cells(errors.mean(axis=0).tolist())))
    columns = ("subject", "method", "seeds", *FRAME_COLUMNS)
    return Table(f"cm², mean over frames 1..k: {family}, mean over seeds", columns, lines)


def _compare_methods(families: Mapping[str, Seeds]) -> Table:
    pooled = {family: pool(seeds) for family, seeds in families.items()}
    lines = []
    for (family, method), (other, reference) in PAIRS:
        if family in pooled and other in pooled:
            ratios = bootstrap_ratios(pooled[family].sums[method], pooled[other].sums[reference])
            name = f"{family}, {METHODS[method]} ÷ {other}, {METHODS[reference]}"
            lines.append((name, *tell_ratios(ratios)))
    title = (
        f"Ratios on the same clips of subjects {', '.join(TEST_SUBJECTS)}, errors of a clip "
        "averaged over seeds, with a bootstrap over clips"
    )
    return Table(title, ("", *RATIO_COLUMNS), lines)


STUDY = Study("main", "What does the paper's protocol give?", 1, plan, compute, tell, summarise)
