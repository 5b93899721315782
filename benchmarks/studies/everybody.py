"""Is anybody worse off? Every subject of UTD-MHAD as a new person, by every single trial."""

from collections.abc import Sequence
from typing import Any

from benchmarks.studies.bases import SHIPPED_BASE
from benchmarks.studies.cache import Row
from benchmarks.studies.measured import LAST, Measured, measure
from benchmarks.studies.personal import compare_versions, is_promoted
from benchmarks.studies.recordings import UTD, is_examinee, read_person
from benchmarks.studies.study import Lab, Options, Study, Unit
from benchmarks.studies.tables import Table, percent, tell_ratio, tell_spread
from models.metrics import Ratio

SUBJECTS = ("1", "2", "3", "4", "5", "6", "7")
TRIALS = ("1", "2", "3", "4")
METHODS = {"served": "with judge and gate", "plain": "without"}
MARGIN = 1.05


def find_base(person: str) -> str:
    """Name a base that never saw a person."""
    return SHIPPED_BASE if is_examinee(person) else f"without-{person.replace('/', '-')}"


def plan(_: Options) -> list[Unit]:
    """List a unit for each subject and trial."""
    return [
        Unit(
            f"subject {subject}, trial {trial}",
            find_base(f"{UTD}/{subject}"),
            f"{UTD}/{subject}",
            {"trial": trial},
            seconds=85.0,
        )
        for trial in TRIALS
        for subject in SUBJECTS
    ]


def compute(unit: Unit, lab: Lab) -> dict[str, Any]:
    """Fit to one trial and measure on the others."""
    person, trial = unit.person, unit.settings["trial"]
    methods, told = compare_versions(
        lab.read_base(unit.base), read_person(lab.place, person, trial)
    )
    others = [other for other in TRIALS if other != trial]
    return {**told, "errors": measure(methods, read_person(lab.place, person, *others)).as_json()}


def tell(row: Row) -> str:
    """Write a row in a line."""
    found = Measured.from_json(row["errors"])
    ratios = [f"{method} {found.ratio(method, 'base'):.3f}" for method in METHODS]
    return f"{row['verdict']}, ÷ base at frame {LAST}: {', '.join(ratios)}"


def summarise(rows: Sequence[Row]) -> list[Table]:
    """Count who is worse off, with judge and gate and without."""
    found = [Measured.from_json(row["errors"]) for row in rows]
    promoted = sum(is_promoted(row) for row in rows)
    lines = [_summarise_method(found, method) for method in METHODS]
    columns = ("", *(f"{name} ({method})" for method, name in METHODS.items()))
    names = (
        "versions worse than the base at frame 15",
        "versions worse than the base at some frame of the table",
        f"version and action worse by more than {MARGIN - 1:.0%}, interval above 1",
        "error ÷ base at frame 15, mean and range over versions",
        "largest error ÷ base of a version and action at frame 15",
    )
    table = [(name, *values) for name, *values in zip(names, *lines, strict=True)]
    table.append(("promoted", percent(promoted, len(rows)), "-"))
    title = f"Worse off: {len(rows)} versions, each fitted to one trial and tested on the others"
    return [Table(title, columns, table), _list_versions(rows, found), _list_harmed(rows, found)]


def _summarise_method(found: Sequence[Measured], method: str) -> list[str]:
    ratios = [one.ratio(method, "base") for one in found]
    worst = [max(ratio.value for ratio in one.compare(method, "base").values()) for one in found]
    actions = [ratio for one in found for ratio in compare_actions(one, method).values()]
    harmed = sum(is_harmed(ratio) for ratio in actions)
    return [
        percent(sum(ratio > 1 for ratio in ratios), len(ratios)),
        percent(sum(ratio > 1 for ratio in worst), len(worst)),
        percent(harmed, len(actions)),
        tell_spread(ratios),
        f"{max(ratio.value for ratio in actions):.2f}",
    ]


def compare_actions(found: Measured, method: str) -> dict[str, Ratio]:
    """Divide a method's error by the base's at the last frame, for each action."""
    return {
        action: found.pick_action(action).compare(method, "base")[LAST]
        for action in dict.fromkeys(found.actions)
    }


def is_harmed(ratio: Ratio) -> bool:
    """Tell whether an action is surely worse off, and by how much that matters."""
    return ratio.value > MARGIN and ratio.low > 1


def _list_versions(rows: Sequence[Row], found: Sequence[Measured]) -> Table:
    lines = [
        (
            row["unit"],
            "promoted" if is_promoted(row) else row["verdict"],
            f"{row['reach']}",
            *(tell_ratio(one.compare(method, "base")[LAST]) for method in METHODS),
        )
        for row, one in zip(rows, found, strict=True)
    ]
    columns = ("fitted to", "judge", "reach", *METHODS.values())
    return Table(f"Error ÷ base at frame {LAST}, with a bootstrap over clips", columns, lines)


def _list_harmed(rows: Sequence[Row], found: Sequence[Measured]) -> Table:
    lines = [
        (row["unit"], action, name, tell_ratio(ratio))
        for row, one in zip(rows, found, strict=True)
        for method, name in METHODS.items()
        for action, ratio in compare_actions(one, method).items()
        if is_harmed(ratio)
    ]
    return Table("Actions that are surely worse off", ("fitted to", "action", "", "÷ base"), lines)


STUDY = Study("everybody", "Is anybody worse off?", 1, plan, compute, tell, summarise)
