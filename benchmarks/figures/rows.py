"""What the studies measured, as the figures want it."""

from collections.abc import Sequence

from benchmarks.studies import main, seconds
from benchmarks.studies.cache import RESULTS, Cache, Row
from benchmarks.studies.main import Seeds, by_seed
from benchmarks.studies.measured import Measured
from benchmarks.studies.study import subject_of


class MissingError(Exception):
    """A figure lacks what it shows; says how to get it."""


def read_seeds(family: str) -> Seeds:
    """Give what was measured with bases of a family, by seed and subject.

    Raises:
        MissingError: no seed is whole.
    """
    seeds = by_seed(_read(main.STUDY.name), family)
    if not seeds:
        raise MissingError("make study-main")
    return seeds


def read_fits(method: str) -> list[tuple[str, float, float]]:
    """Give subject, seconds, and error ÷ base at half a second, of each fit within a budget.

    Args:
        method: of `seconds.METHODS`.

    Raises:
        MissingError: nothing was measured.
    """
    rows = [row for row in _read(seconds.STUDY.name) if "budget_s" in row]
    if not rows:
        raise MissingError("make study-seconds")
    return sorted(_place(row, method) for row in rows)


def read_corrections() -> list[tuple[str, float, float]]:
    """Give the same of each correction in closed form."""
    rows = [row for row in _read(seconds.STUDY.name) if "correction" in row]
    return sorted(_place(row, "plain") for row in rows)


def _place(row: Row, method: str) -> tuple[str, float, float]:
    ratio = Measured.from_json(row["errors"]).ratio(method, "base")
    return subject_of(row), seconds.tell_cost(row, method), ratio


def _read(study: str) -> Sequence[Row]:
    return list(Cache(RESULTS / f"{study}.jsonl").read().values())
