"""Motion that was not recorded: fitted to half of the actions, tested on these and the others."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from benchmarks.studies.cache import Row
from benchmarks.studies.everybody import find_base
from benchmarks.studies.measured import LAST, Measured, measure
from benchmarks.studies.personal import compare_versions, is_promoted
from benchmarks.studies.recordings import UTD, read_person
from benchmarks.studies.study import Lab, Options, Study, Unit, subject_of
from benchmarks.studies.tables import Table, percent
from models.data.splits import PERSONAL_TRIAL, TEST_SUBJECTS, TEST_TRIALS

DRAWS = 10
ACTIONS = 27
METHODS = {"served": "with judge and gate", "plain": "without"}


def draw_actions(draw: int) -> list[str]:
    """Draw half of the actions: 13 or 14 of 27."""
    order = np.random.default_rng((2026, draw)).permutation(ACTIONS) + 1
    return sorted((str(action) for action in order[: ACTIONS // 2 + draw % 2]), key=int)


def plan(options: Options) -> list[Unit]:
    """List a unit for each subject and draw; other subjects with `--people utd-mhad/3,…`."""
    people = options.people or tuple(f"{UTD}/{subject}" for subject in TEST_SUBJECTS)
    return [
        Unit(
            f"{person}, draw {draw}",
            find_base(person),
            person,
            {"draw": draw, "actions": draw_actions(draw)},
            seconds=55.0,
        )
        for draw in range(DRAWS)
        for person in people
    ]


def compute(unit: Unit, lab: Lab) -> dict[str, Any]:
    """Fit to half of the actions of trial 1, and measure on all of the other trials."""
    person, actions = unit.person, set(unit.settings["actions"])
    trial = read_person(lab.place, person, PERSONAL_TRIAL)
    half = [clip for clip in trial if clip.action in actions]
    methods, told = compare_versions(lab.read_base(unit.base), half)
    test = read_person(lab.place, person, *TEST_TRIALS)
    return {**told, "errors": measure(methods, test).as_json()}


def split(row: Row) -> dict[str, Measured]:
    """Divide what was measured into the actions that were seen and the others."""
    found, actions = Measured.from_json(row["errors"]), set(row["actions"])
    return {
        "seen": found.pick(lambda action, _: action in actions),
        "unseen": found.pick(lambda action, _: action not in actions),
    }


def tell(row: Row) -> str:
    """Write a row in a line."""
    parts = split(row)
    told = [
        f"{method} {part} {found.ratio(method, 'base'):.3f}"
        for method in METHODS
        for part, found in parts.items()
    ]
    return f"{row['verdict']}, ÷ base at frame {LAST}: {', '.join(told)}"


def summarise(rows: Sequence[Row]) -> list[Table]:
    """Give means and the worst draw, by subject and over all."""
    groups = {
        subject_of(row): [r for r in rows if subject_of(r) == subject_of(row)] for row in rows
    }
    if len(groups) > 1:
        groups["all"] = list(rows)
    lines = [line for name, own in groups.items() for line in _summarise_group(name, own)]
    columns = (
        "subject, method",
        "draws",
        "promoted",
        f"seen at frame {LAST}: mean (worst)",
        f"unseen at frame {LAST}: mean (worst)",
        "seen, mean of frames",
        "unseen, mean of frames: mean (worst)",
        "gain kept on seen",
    )
    title = "Error ÷ base, fitted to half of the actions of trial 1, tested on trials 2 to 4"
    return [Table(title, columns, lines)]


def _summarise_group(name: str, rows: Sequence[Row]) -> list[tuple[str, ...]]:
    parts = [split(row) for row in rows]
    promoted = percent(sum(is_promoted(row) for row in rows), len(rows))
    seen = {m: _ratios(parts, "seen", m) for m in METHODS}
    lines: list[tuple[str, ...]] = []
    for method, called in METHODS.items():
        kept = (1 - seen[method].mean()) / (1 - seen["plain"].mean())
        lines.append(
            (
                f"{name}, {called}",
                str(len(rows)),
                promoted if method == "served" else "-",
                _tell(seen[method]),
                _tell(_ratios(parts, "unseen", method)),
                f"{_ratios(parts, 'seen', method, mean=True).mean():.3f}",
                _tell(_ratios(parts, "unseen", method, mean=True)),
                f"{kept:.0%}",
            )
        )
    return lines


def _ratios(
    parts: Sequence[dict[str, Measured]], part: str, method: str, *, mean: bool = False
) -> np.ndarray:
    found = [one[part] for one in parts]
    if mean:
        return np.array([one.mean_ratio(method, "base") for one in found])
    return np.array([one.ratio(method, "base") for one in found])


def _tell(ratios: np.ndarray) -> str:
    return f"{ratios.mean():.3f} ({ratios.max():.3f})"


STUDY = Study("unseen", "Does it hurt on motion unlike it?", 1, plan, compute, tell, summarise)
