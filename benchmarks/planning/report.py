"""The tables of the comparison, as Markdown and as JSON."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from benchmarks.planning.measures import MEASURES, Estimate, Tally, estimate
from benchmarks.planning.people import METHODS
from benchmarks.planning.robot import Constants
from benchmarks.studies.tables import Table

COMPARED = (("base", "zero velocity"), ("personal", "base"), ("truth", "personal"))
Tallies = Mapping[tuple[float, str], Tally]
"""By margin and method."""


@dataclass(frozen=True, eq=False)
class Report:
    """Everything that was measured.

    Attributes:
        constants: of the planner, as chosen on other people.
        tallies: of every margin and method.
        people: whose clips, and how many.
        base: sha256 of the base that forecast, and that versions were fitted on.
        tuned: what the constants were chosen from; empty where they were given.
    """

    constants: Constants
    tallies: Tallies
    people: Mapping[str, int]
    base: str
    tuned: Sequence[Mapping[str, Any]] = ()

    @property
    def margins(self) -> tuple[float, ...]:
        """Give the margins that were tried, in order."""
        return tuple(sorted({margin for margin, _ in self.tallies}))

    def estimate(self, margin: float, method: str) -> dict[str, Estimate]:
        """Give a method's figures at a margin."""
        return estimate(self.tallies[margin, method])

    def compare(self, margin: float, method: str, other: str) -> dict[str, Estimate]:
        """Give how much two methods differ at a margin."""
        return estimate(self.tallies[margin, method], self.tallies[margin, other])

    def make_tables(self) -> list[Table]:
        """Give the figures at the chosen margin, the differences there, and all margins."""
        return [self._make_main(), self._make_differences(), self._make_margins()]

    def _make_main(self) -> Table:
        titles = tuple(measure.title for measure in MEASURES.values())
        rows = [(m, *_tell(self.estimate(self.constants.margin, m))) for m in METHODS]
        return Table(f"At a margin of {self.constants.margin:g} m:", ("forecast", *titles), rows)

    def _make_differences(self) -> Table:
        titles = tuple(measure.title for measure in MEASURES.values())
        rows = [
            (f"{a} less {b}", *_tell(self.compare(self.constants.margin, a, b), sign=True))
            for a, b in COMPARED
        ]
        return Table("Differences on the same clips:", ("", *titles), rows)

    def _make_margins(self) -> Table:
        names = ("closest_cm", "too_close_s_per_min", "progress_m_per_s")
        heads = tuple(MEASURES[name].title for name in names)
        rows = []
        for margin in self.margins:
            for method in METHODS:
                found = self.estimate(margin, method)
                told = (found[name].tell(MEASURES[name].digits) for name in names)
                rows.append((f"{margin:.2f} m", method, *told))
        return Table("By the margin that the planner keeps:", ("margin", "forecast", *heads), rows)

    def as_json(self) -> dict[str, Any]:
        """Give everything, for `benchmarks/results/planning.json`."""
        margins = {
            f"{margin:g}": {m: _as_json(self.estimate(margin, m)) for m in METHODS}
            for margin in self.margins
        }
        differences = {
            f"{margin:g}": {f"{a} - {b}": _as_json(self.compare(margin, a, b)) for a, b in COMPARED}
            for margin in self.margins
        }
        return {
            "base": self.base,
            "constants": asdict(self.constants),
            "clips": dict(self.people),
            "margins": margins,
            "differences": differences,
            "tuned": list(self.tuned),
        }


def _tell(found: Mapping[str, Estimate], *, sign: bool = False) -> list[str]:
    return [one.tell(MEASURES[name].digits, sign=sign) for name, one in found.items()]


def _as_json(found: Mapping[str, Estimate]) -> dict[str, dict[str, float]]:
    return {
        name: {part: round(value, 4) for part, value in asdict(one).items()}
        for name, one in found.items()
    }
