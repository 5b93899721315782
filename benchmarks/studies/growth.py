"""More trials: fitted to one, two and three, tested on the fourth."""

from collections.abc import Sequence
from typing import Any

from benchmarks.studies.cache import Row
from benchmarks.studies.everybody import find_base
from benchmarks.studies.measured import LAST, Measured, join, measure
from benchmarks.studies.personal import is_promoted, make_served
from benchmarks.studies.recordings import UTD, read_person
from benchmarks.studies.study import Lab, Options, Study, Unit
from benchmarks.studies.tables import FRAME_COLUMNS, RATIO_COLUMNS, Table, cells, tell_ratios
from models.checkpoint import load_checkpoint
from models.data.splits import TEST_SUBJECTS

TRIALS, TEST_TRIAL = ("1", "2", "3"), "4"


def plan(options: Options) -> list[Unit]:
    """List a unit for each subject and number of trials."""
    subjects = [person.split("/")[1] for person in options.people] or TEST_SUBJECTS
    return [
        Unit(
            f"subject {subject}, trials 1 to {count}",
            find_base(subject),
            {"subject": subject, "trials": list(TRIALS[:count])},
            seconds=30.0 + 40 * count,
        )
        for count in range(1, 4)
        for subject in subjects
    ]


def compute(unit: Unit, lab: Lab) -> dict[str, Any]:
    """Fit to the first trials, and measure on the last one."""
    person, base = f"{UTD}/{unit.settings['subject']}", lab.read_base(unit.base)
    served = make_served(base, read_person(lab.place, person, *unit.settings["trials"]))
    methods = {"base": load_checkpoint(base).predictor, "served": served.forecaster}
    found = measure(methods, read_person(lab.place, person, TEST_TRIAL))
    return {**unit.settings, **served.describe(), "errors": found.as_json()}


def tell(row: Row) -> str:
    """Write a row in a line."""
    found = Measured.from_json(row["errors"])
    return f"{row['verdict']}, ÷ base at frame {LAST}: {found.ratio('served', 'base'):.3f}"


def summarise(rows: Sequence[Row]) -> list[Table]:
    """Show the errors by trials, and the ratios over all subjects."""
    lines = []
    for row in sorted(rows, key=lambda row: (row["subject"], len(row["trials"]))):
        found = Measured.from_json(row["errors"])
        if len(row["trials"]) == 1:
            lines.append((row["subject"], "none", "-", *cells(found.cm2("base"))))
        judge = "promoted" if is_promoted(row) else row["verdict"]
        lines.append((row["subject"], ", ".join(row["trials"]), judge, *cells(found.cm2("served"))))
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
