"""Train every base of the studies."""

from collections.abc import Sequence
from typing import Any

from benchmarks.studies.bases import SHIPPED_BASE, list_recipes, train_base
from benchmarks.studies.cache import Row
from benchmarks.studies.study import Lab, Options, Study, Unit
from benchmarks.studies.tables import Table


def plan(_: Options) -> list[Unit]:
    """List the bases that are not shipped, those that give most evidence first."""
    return [
        Unit(name, settings={"name": name}, seconds=recipe.seconds, personal=False)
        for name, recipe in sorted(list_recipes().items(), key=lambda pair: _order(pair[0]))
        if name != SHIPPED_BASE
    ]


def compute(unit: Unit, lab: Lab) -> dict[str, Any]:
    """Train one."""
    return train_base(lab.recipes[unit.name], lab.place)


def tell(row: Row) -> str:
    """Say what became of it."""
    return f"{row['steps']} steps, {row['training_s']:.0f} s, sha256 {row['sha256'][:12]}"


def summarise(rows: Sequence[Row]) -> list[Table]:
    """Say who trained them, and how long it took."""
    lines = [
        (
            row["unit"],
            ", ".join(f"{name}: {len(own['subjects'])}" for name, own in row["data"].items()),
            ", ".join(row["left_out"]) or "-",
            str(row["steps"]),
            f"{row['training_s']:.0f}" if row["steps"] == row["steps_of_this_run"] else "resumed",
            row["sha256"][:12],
        )
        for row in rows
    ]
    columns = ("base", "people", "left out", "steps", "seconds", "sha256")
    return [Table("Bases", columns, lines)]


def _order(name: str) -> int:
    order = ("without-utd-mhad-", "shipped-", "without-", "paper-", "simlpe-", "ablation-")
    return next(place for place, start in enumerate(order) if name.startswith(start))


STUDY = Study("bases", "Which bases are compared?", 1, plan, compute, tell, summarise)
