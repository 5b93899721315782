"""Run a study: train the bases that it lacks, compute the rows that it lacks, sum up."""

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from rich.console import Console

from benchmarks.studies import ablation, everybody, growth, main, seconds, training, unseen, wild
from benchmarks.studies.bases import find_sha256
from benchmarks.studies.cache import RESULTS, Cache, Row
from benchmarks.studies.pool import work
from benchmarks.studies.recordings import Place, is_examinee
from benchmarks.studies.study import Lab, Options, Study, Unit, key_of
from benchmarks.studies.tables import Table
from models.training import ledger
from models.training.ledger import record_reading

STUDIES: dict[str, Study] = {
    study.name: study
    for study in (
        training.STUDY,
        everybody.STUDY,
        main.STUDY,
        unseen.STUDY,
        growth.STUDY,
        wild.STUDY,
        seconds.STUDY,
        ablation.STUDY,
    )
}
"""In the order that gives most evidence first."""
ANSWERS = [name for name in STUDIES if name != training.STUDY.name]
"""Without the training of bases, which happens as it is needed."""
READINGS = Path(ledger.__file__).with_name("readings.jsonl")


@dataclass(frozen=True)
class Run:
    """How to run studies.

    Attributes:
        place: where the recordings are.
        options: see `Options`.
        only: names of units, * for any; the others are left alone.
        jobs: processes at once.
        fresh: compute rows that are there as well.
        folder: where rows are kept.
        ledger: of readings of people who only test.
    """

    place: Place
    options: Options = field(default_factory=Options)
    only: tuple[str, ...] = ()
    jobs: int = 2
    fresh: bool = False
    folder: Path = RESULTS
    ledger: Path = READINGS

    def cache(self, study: Study) -> Cache:
        """Give the rows of a study."""
        return Cache(self.folder / f"{study.name}.jsonl")

    def plan(self, study: Study) -> list[Unit]:
        """List the units that were asked for."""
        units = study.plan(self.options)
        return [unit for unit in units if not self.only or _is_named(unit.name, self.only)]


@dataclass(frozen=True)
class Job:
    """A unit on its way to a process."""

    study: str
    unit: Unit
    place: Place


def run_study(study: Study, run: Run, console: Console) -> list[Row]:
    """Compute what is missing and give all rows that were asked for.

    Rows whose base is there come first; then the other bases are trained.
    """
    missing = list_missing(study, run)
    if study is training.STUDY and run.fresh:
        for unit in missing:
            Lab(run.place).find_base(unit.name).unlink(missing_ok=True)
    absent = list_absent(missing, run)
    compute_rows(study, [unit for unit in missing if unit.base not in absent], run, console)
    if absent:
        run_study(training.STUDY, replace(run, only=tuple(absent), fresh=False), console)
        compute_rows(study, [unit for unit in missing if unit.base in absent], run, console)
    return read_rows(study, run)


def compute_rows(study: Study, units: Sequence[Unit], run: Run, console: Console) -> None:
    """Compute some rows, each kept as soon as it is there."""
    cache, lab, began = run.cache(study), Lab(run.place), time.monotonic()
    jobs = [Job(study.name, unit, run.place) for unit in units]
    done: list[Unit] = []
    try:
        for job, row in work(compute, jobs, at_once=1 if study.alone else run.jobs):
            done.append(job.unit)
            told = "failed"
            if not isinstance(row, Exception):
                whole = {**name_row(job.unit), "key": key_of(study, job.unit, lab), **row}
                cache.add(whole)
                told = study.headline(whole)
            spent = f"{len(done)}/{len(jobs)}, {time.monotonic() - began:.0f} s"
            told = f"[{spent}] {study.name} {job.unit.name}: {told}"
            console.print(told, markup=False, highlight=False)
    finally:
        if done:
            cache.tidy()
            note_reading(study, done, run)


def note_reading(study: Study, units: Sequence[Unit], run: Run) -> None:
    """Leave a line in the ledger where people were read who only test."""
    read = [unit for unit in units if unit.person and is_examinee(unit.person)]
    rows = read_rows(study, run)
    if not (read and rows):
        return
    bases, lab = sorted({unit.base for unit in read}), Lab(run.place)
    summary = study.summarise(rows)[0]
    record_reading(
        run.ledger,
        what=f"python -m benchmarks.studies {study.name}",
        config={
            "people": sorted({unit.person for unit in read}),
            "bases": {name: find_sha256(lab.recipes[name], run.place) for name in bases if name},
            "rows": len(read),
        },
        figures=asdict(summary),
    )


def compute(job: Job) -> Row:
    """Compute one row; runs in a process of its own."""
    began = time.monotonic()
    row: dict[str, Any] = STUDIES[job.study].compute(job.unit, Lab(job.place))
    return {"seconds": round(time.monotonic() - began, 1), **row}


def name_row(unit: Unit) -> Row:
    """Say what a row is about."""
    return {"unit": unit.name, "base": unit.base, "person": unit.person, **unit.settings}


def list_absent(units: Sequence[Unit], run: Run) -> list[str]:
    """Name the bases of units that have to be trained."""
    lab = Lab(run.place)
    names = dict.fromkeys(unit.base for unit in units if unit.base)
    return [name for name in names if not lab.find_base(name).exists()]


def list_missing(study: Study, run: Run) -> list[Unit]:
    """List the units whose row is not there."""
    units = run.plan(study)
    if run.fresh:
        return units
    lab, known = Lab(run.place), run.cache(study).read().values()
    if study is training.STUDY:
        trained = {row["recipe"] for row in known}
        return [unit for unit in units if not _is_trained(unit, lab, trained)]
    keys = {row["key"] for row in known}
    return [unit for unit in units if key_of(study, unit, lab) not in keys]


def _is_trained(unit: Unit, lab: Lab, trained: set[str]) -> bool:
    recipe = lab.recipes[unit.name]
    return recipe.key(lab.place) in trained and lab.find_base(unit.name).exists()


def read_rows(study: Study, run: Run) -> list[Row]:
    """Give the rows that are there, in the order of the plan."""
    rows = run.cache(study).read()
    return [rows[unit.name] for unit in study.plan(run.options) if unit.name in rows]


def sum_up(name: str, run: Run) -> Sequence[Table]:
    """Give the tables of a study from the rows that are there; none where there are none.

    Raises:
        ValueError: no study has this name.
    """
    if name not in STUDIES:
        raise ValueError(f"no study is called {name!r}; there are {', '.join(STUDIES)}")
    study = STUDIES[name]
    rows = read_rows(study, run)
    return study.summarise(rows) if rows else ()


def describe_missing(study: Study, run: Run) -> Sequence[str]:
    """Say what would be computed, and how long it would take."""
    units = list_missing(study, run)
    recipes = Lab(run.place).recipes
    absent = {name: recipes[name].seconds for name in list_absent(units, run)}
    jobs = 1 if study.alone else run.jobs
    minutes = (sum(unit.seconds for unit in units) / jobs + sum(absent.values()) / run.jobs) / 60
    return [
        *(f"{study.name}, base {name}: {seconds:.0f} s" for name, seconds in absent.items()),
        *(f"{study.name} {unit.name}: {unit.seconds:.0f} s" for unit in units),
        f"{study.name}: {len(units)} rows and {len(absent)} bases, "
        f"about {minutes:.0f} min with {jobs} jobs",
    ]


def _is_named(name: str, patterns: Sequence[str]) -> bool:
    return any(fnmatchcase(name, pattern) for pattern in patterns)
