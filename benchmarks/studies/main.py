"""The protocol of the paper: base and personal versions on subjects 2, 4 and 6, over seeds."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from benchmarks.studies.cache import Row
from benchmarks.studies.measured import LAST, Measured, average, join, measure
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
from models.data.splits import PERSONAL_TRIAL, TEST_SUBJECTS, TEST_TRIALS
from models.metrics import FRAMES
from models.training.evaluate import PUBLISHED

FAMILIES = ("shipped", "paper")
SEEDS = (0, 1, 2)
METHODS = {
    "base": "base",
    "served": "personal, with judge and gate",
    "plain": "personal, without",
}
PAPER_ROWS = {"base": "paper: base", "served": "paper: personal", "plain": "paper: personal"}
EARLY, LATE = (2, 4), (8, 10, 13, 15)


def plan(_: Options) -> list[Unit]:
    """List a unit for each base and subject."""
    return [
        Unit(
            f"{family}-{seed}, subject {subject}",
            f"{family}-{seed}",
            f"{UTD}/{subject}",
            {"seed": seed, "family": family},
            seconds=85.0,
        )
        for seed in SEEDS
        for family in FAMILIES
        for subject in TEST_SUBJECTS
    ]


def compute(unit: Unit, lab: Lab) -> dict[str, Any]:
    """Fit to trial 1 and measure on the others."""
    person, seed = unit.person, unit.settings["seed"]
    trial = read_person(lab.place, person, PERSONAL_TRIAL)
    methods, told = compare_versions(lab.read_base(unit.base), trial, seed=seed)
    test = read_person(lab.place, person, *TEST_TRIALS)
    return {**told, "errors": measure(methods, test).as_json()}


def tell(row: Row) -> str:
    """Write a row in a line."""
    found = Measured.from_json(row["errors"])
    errors = [f"{method} {found.cm2(method)[-1]:.2f}" for method in METHODS]
    return f"{row['verdict']}, cm² at frame {LAST}: {', '.join(errors)}"


def summarise(rows: Sequence[Row]) -> list[Table]:
    """Compare with the paper's rows, show the table, and compare methods on the same clips."""
    families = {row["family"]: [r for r in rows if r["family"] == row["family"]] for row in rows}
    return [
        _compare_with_paper(families),
        *(_show_errors(family, own) for family, own in families.items()),
        _compare_methods(families),
    ]


def compare_with_paper(found: dict[str, Measured], method: str) -> dict[str, float]:
    """Divide by the paper's rows: mean over the late cells and the early ones, and the worst.

    Args:
        found: by subject.
        method: one of `METHODS`.
    """
    ratios = np.array(
        [
            np.divide(one.cm2(method), PUBLISHED[PAPER_ROWS[method], subject])
            for subject, one in found.items()
        ]
    )
    late, early = ([FRAMES.index(frame) for frame in chosen] for chosen in (LATE, EARLY))
    return {
        "late": float(ratios[:, late].mean()),
        "early": float(ratios[:, early].mean()),
        "worst": float(ratios.max()),
    }


def by_seed(rows: Sequence[Row]) -> dict[int, dict[str, Measured]]:
    """Sort what was measured by seed and subject; seeds that lack a subject are left out."""
    sorted_: dict[int, dict[str, Measured]] = {}
    for row in rows:
        found = Measured.from_json(row["errors"])
        sorted_.setdefault(row["seed"], {})[subject_of(row)] = found
    return {seed: one for seed, one in sorted_.items() if len(one) == len(TEST_SUBJECTS)}


def _compare_with_paper(families: dict[str, list[Row]]) -> Table:
    lines = []
    for family, rows in families.items():
        seeds = by_seed(rows).values()
        for method, name in METHODS.items():
            if seeds:
                found = [compare_with_paper(one, method) for one in seeds]
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


def _show_errors(family: str, rows: Sequence[Row]) -> Table:
    lines = []
    for subject in TEST_SUBJECTS:
        own = [Measured.from_json(r["errors"]) for r in rows if subject_of(r) == subject]
        for method, name in METHODS.items() if own else ():
            errors = np.array([one.cm2(method) for one in own])
            lines.append((subject, name, str(len(own)), *cells(errors.mean(axis=0))))
    columns = ("subject", "method", "seeds", *FRAME_COLUMNS)
    return Table(f"cm², mean over frames 1..k: {family}, mean over seeds", columns, lines)


def _compare_methods(families: dict[str, list[Row]]) -> Table:
    """Compare on the same clips; errors of a clip are means over seeds."""
    lines = []
    for family, rows in families.items():
        seeds = by_seed(rows).values()
        if not seeds:
            continue
        found = join([average([one[s] for one in seeds]) for s in TEST_SUBJECTS])
        for method, reference in (("served", "base"), ("plain", "base"), ("served", "plain")):
            ratios = found.compare(method, reference)
            name = f"{family}: {METHODS[method]} ÷ {METHODS[reference]}"
            lines.append((name, *tell_ratios(ratios)))
    title = "Ratios on the same clips of subjects 2, 4, 6, with a bootstrap over clips"
    return Table(title, ("", *RATIO_COLUMNS), lines)


STUDY = Study("main", "What does the paper's protocol give?", 1, plan, compute, tell, summarise)
