"""Run a study: train the bases that it lacks, compute the rows that it lacks, sum up."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from rich.console import Console

from benchmarks.studies import everybody, growth, main, training, unseen, wild
from benchmarks.studies.bases import SHIPPED_BASE
from benchmarks.studies.cache import RESULTS, Cache, Row
from benchmarks.studies.pool import work
from benchmarks.studies.recordings import Place
from benchmarks.studies.study import Lab, Options, Study, Unit, key_of

STUDIES: dict[str, Study] = {
    study.name: study
    for study in (
        training.STUDY,
        main.STUDY,
        everybody.STUDY,
        unseen.STUDY,
        growth.STUDY,
        wild.STUDY,
    )
}
"""In the order that gives most evidence first."""


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
    """

    place: Place
    options: Options = field(default_factory=Options)
    only: tuple[str, ...] = ()
    jobs: int = 2
    fresh: bool = False
    folder: Path = RESULTS

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
    """Compute what is missing and give all rows that were asked for."""
    if study is not training.STUDY:
        train_missing(study, run, console)
    units = list_missing(study, run)
    cache, lab, began = run.cache(study), Lab(run.place), time.monotonic()
    jobs = [Job(study.name, unit, run.place) for unit in units]
    for done, (job, row) in enumerate(work(compute, jobs, at_once=run.jobs), start=1):
        key = key_of(study, job.unit, lab)
        whole = {"key": key, "unit": job.unit.name, "base": job.unit.base, **row}
        cache.add(whole)
        spent = time.monotonic() - began
        told = f"{study.name} {job.unit.name}: {study.headline(whole)}"
        console.print(f"[{done}/{len(jobs)}, {spent:.0f} s] {told}", markup=False, highlight=False)
    if units:
        cache.tidy()
    return read_rows(study, run)


def compute(job: Job) -> Row:
    """Compute one row; runs in a process of its own."""
    began = time.monotonic()
    row: dict[str, Any] = STUDIES[job.study].compute(job.unit, Lab(job.place))
    return {"seconds": round(time.monotonic() - began, 1), **row}


def train_missing(study: Study, run: Run, console: Console) -> None:
    """Train the bases without which a missing row cannot be computed."""
    names = {unit.base for unit in list_missing(study, run)} - {"", SHIPPED_BASE}
    lab = Lab(run.place)
    absent = tuple(name for name in names if not lab.recipes[name].path(run.place).exists())
    if absent:
        run_study(training.STUDY, replace(run, only=absent, fresh=False), console)


def list_missing(study: Study, run: Run) -> list[Unit]:
    """List the units whose row is not there."""
    units = run.plan(study)
    if run.fresh:
        return units
    lab, known = Lab(run.place), run.cache(study).read()
    if study is training.STUDY:
        return [u for u in units if not lab.recipes[u.name].path(run.place).exists()]
    return [unit for unit in units if key_of(study, unit, lab) not in known]


def read_rows(study: Study, run: Run) -> list[Row]:
    """Give the rows that are there, in the order of the plan."""
    latest = {row["unit"]: row for row in run.cache(study).read().values()}
    return [latest[unit.name] for unit in study.plan(run.options) if unit.name in latest]


def describe_missing(study: Study, run: Run) -> Sequence[str]:
    """Say what would be computed, and how long it would take."""
    units = list_missing(study, run)
    lines = [f"{study.name} {unit.name}: {unit.seconds:.0f} s" for unit in units]
    total = sum(unit.seconds for unit in units) / run.jobs / 60
    return [*lines, f"{study.name}: {len(units)} rows, about {total:.0f} min with {run.jobs} jobs"]


def _is_named(name: str, patterns: Sequence[str]) -> bool:
    return any(fnmatchcase(name, pattern) for pattern in patterns)
