"""More trials: fitted to one, two and three, tested on the fourth."""

from collections.abc import Sequence
from typing import Any

from benchmarks.studies.cache import Row
from benchmarks.studies.everybody import find_base
from benchmarks.studies.measured import LAST, Measured, join, measure
from benchmarks.studies.personal import is_promoted, make_served
from benchmarks.studies.recordings import UTD, read_person
from benchmarks.studies.study import Lab, Options, Study, Unit, subject_of
from benchmarks.studies.tables import FRAME_COLUMNS, RATIO_COLUMNS, Table, cells, tell_ratios
from models.checkpoint import load_checkpoint
from models.data.splits import TEST_SUBJECTS

TRIALS, TEST_TRIAL = ("1", "2", "3"), "4"


def plan(options: Options) -> list[Unit]:
    """List a unit for each subject and number of trials."""
    people = options.people or tuple(f"{UTD}/{subject}" for subject in TEST_SUBJECTS)
    return [
        Unit(
            f"{person}, trials 1 to {count}",
            find_base(person),
            person,
            {"trials": list(TRIALS[:count])},
            seconds=30.0 + 40 * count,
        )
        for count in range(1, 4)
        for person in people
    ]


def compute(unit: Unit, lab: Lab) -> dict[str, Any]:
    """Fit to the first trials, and measure on the last one."""
    person, base = unit.person, lab.read_base(unit.base)
    served = make_served(base, read_person(lab.place, person, *unit.settings["trials"]))
    methods = {"base": load_checkpoint(base).predictor, "served": served.forecaster}
    found = measure(methods, read_person(lab.place, person, TEST_TRIAL))
    return {**served.describe(), "errors": found.as_json()}


def tell(row: Row) -> str:
    """Write a row in a line."""
    found = Measured.from_json(row["errors"])
    return f"{row['verdict']}, ÷ base at frame {LAST}: {found.ratio('served', 'base'):.3f}"


def summarise(rows: Sequence[Row]) -> list[Table]:
    """Show the errors by trials, and the ratios over all subjects."""
    lines = []
    for row in sorted(rows, key=lambda row: (subject_of(row), len(row["trials"]))):
        found = Measured.from_json(row["errors"])
        if len(row["trials"]) == 1:
            lines.append((subject_of(row), "none", "-", *cells(found.cm2("base"))))
        judge = "promoted" if is_promoted(row) else row["verdict"]
        lines.append(
            (subject_of(row), ", ".join(row["trials"]), judge, *cells(found.cm2("served")))
        )
    columns = ("subject", "fitted to trials", "judge", *FRAME_COLUMNS)
    title = f"cm², mean over frames 1..k, on trial {TEST_TRIAL}"
    return [Table(title, columns, lines), _pool(rows)]


def _pool(rows: Sequence[Row]) -> Table:
    lines = []
    for count in sorted({len(row["trials"]) for row in rows}):
        own = [Measured.from_json(r["errors"]) for r in rows if len(r["trials"]) == count]
        ratios = join(own).compare("served", "base")
        lines.append((str(count), str(len(own)), *tell_ratios(ratios)))
    title = "Error ÷ base on the same clips of all subjects, with a bootstrap over clips"
    return Table(title, ("trials", "subjects", *RATIO_COLUMNS), lines)


STUDY = Study("growth", "Do more trials help further?", 1, plan, compute, tell, summarise)
