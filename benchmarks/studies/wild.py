"""People, motion and sensors that training has not seen: error ÷ zero velocity."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from benchmarks.studies.bases import SHIPPED_BASE
from benchmarks.studies.cache import Row
from benchmarks.studies.measured import LAST, Measured, join, measure
from benchmarks.studies.personal import is_promoted, make_served
from benchmarks.studies.recordings import UTD, is_examinee, read_person
from benchmarks.studies.study import Lab, Options, Study, Unit
from benchmarks.studies.tables import (
    FRAME_COLUMNS,
    RATIO_COLUMNS,
    Table,
    tell_ratio,
    tell_ratios,
)
from models.baselines import Forecaster
from models.checkpoint import load_checkpoint
from models.data.clips import Clip
from models.metrics import FRAMES
from models.spec import MotionSpec

PEOPLE = {UTD: 7, "precog": 9, "wmft": 19}
GAP_FRAMES = 30
NEW_PEOPLE, NEW_COLLECTION, PERSONAL = "new people", "new collection", "personal"


def plan(_: Options) -> list[Unit]:
    """List new people, then personal versions of them, then collections left out as a whole."""
    everybody = [f"{source}/{n + 1}" for source, count in PEOPLE.items() for n in range(count)]
    new = [person for person in everybody if is_examinee(person)]
    units = [_unit(NEW_PEOPLE, person, SHIPPED_BASE) for person in new]
    units += [
        replace(_unit(PERSONAL, person, SHIPPED_BASE), personal=True, seconds=120.0)
        for person in new
        if not person.startswith(UTD)
    ]
    return units + [
        _unit(NEW_COLLECTION, person, f"without-{person.split('/')[0]}") for person in everybody
    ]


def _unit(part: str, person: str, base: str) -> Unit:
    return Unit(f"{part}, {person}", base, person, {"part": part}, seconds=8.0, personal=False)


def compute(unit: Unit, lab: Lab) -> dict[str, Any]:
    """Measure a base on a person, or a version of that person on the later halves of clips."""
    clips, base = read_person(lab.place, unit.person), lab.read_base(unit.base)
    methods: dict[str, Forecaster] = {"base": load_checkpoint(base).predictor}
    told: dict[str, Any] = {}
    if unit.settings["part"] == PERSONAL:
        clips, learn = cut_later(clips), cut_earlier(clips)
        served = make_served(base, learn)
        methods["served"], told = served.forecaster, served.describe()
    return {**told, "errors": measure(methods, clips).as_json()}


def cut_earlier(clips: Sequence[Clip]) -> list[Clip]:
    """Give the first half of each sequence."""
    return [replace(clip, poses=clip.poses[: len(clip.poses) // 2]) for clip in clips]


def cut_later(clips: Sequence[Clip]) -> list[Clip]:
    """Give the second half of each sequence, without the frames after the first."""
    halves = (
        replace(clip, poses=clip.poses[len(clip.poses) // 2 + GAP_FRAMES :]) for clip in clips
    )
    return [clip for clip in halves if len(clip.poses) >= MotionSpec().frames]


def tell(row: Row) -> str:
    """Write a row in a line."""
    found = Measured.from_json(row["errors"])
    told = f"÷ zero velocity at frame {LAST}: base {found.ratio('base', 'zero_velocity'):.3f}"
    if row["part"] == PERSONAL:
        ratio = found.ratio("served", "zero_velocity")
        told += f", personal {ratio:.3f}, {row['verdict']}"
    return told


def summarise(rows: Sequence[Row]) -> list[Table]:
    """Show each person, and each collection as one."""
    parts = {part: [row for row in rows if row["part"] == part] for part in TITLES}
    tables = [_show(part, own) for part, own in parts.items() if own]
    return [*_sum_up(rows), *tables, *_compare_personal(parts[PERSONAL])]


def _sum_up(rows: Sequence[Row]) -> list[Table]:
    """Show the base on each collection with the interval of every frame, and the mean of all."""
    lines = []
    for part in (NEW_PEOPLE, NEW_COLLECTION):
        own = [row for row in rows if row["part"] == part and is_examinee(row["person"])]
        means = []
        for name, found in group_by_collection(own).items():
            ratios = list(join(found).compare("base", "zero_velocity").values())
            means.append(sum(ratio.value for ratio in ratios) / len(ratios))
            told = (tell_ratio(ratio) for ratio in ratios)
            lines.append((f"{part}, {name.split(',')[0]}", *told, f"{means[-1]:.3f}"))
        if means:
            mean = f"{sum(means) / len(means):.3f}"
            lines.append((f"{part}, mean of {len(means)}", *("" for _ in FRAMES), mean))
    if not lines:
        return []
    title = "People who never train, by collection: base ÷ zero velocity, and 95 % intervals"
    return [Table(title, ("", *FRAME_COLUMNS, "mean"), lines)]


TITLES = {
    NEW_PEOPLE: "New people of the collections: the shipped base ÷ zero velocity",
    NEW_COLLECTION: "Whole collections left out of training: base ÷ zero velocity",
    PERSONAL: "New people, later halves of their sequences: personal ÷ zero velocity",
}


def _show(part: str, rows: Sequence[Row]) -> Table:
    method = "served" if part == PERSONAL else "base"
    lines = [
        (row["person"], *_tell([Measured.from_json(row["errors"])], method, "zero_velocity"))
        for row in rows
    ]
    for name, own in group_by_collection(rows).items():
        lines.append((name, *_tell(own, method, "zero_velocity")))
    return Table(TITLES[part], ("person", *RATIO_COLUMNS), lines)


def group_by_collection(rows: Sequence[Row]) -> dict[str, list[Measured]]:
    """Pool people of a collection: those who train elsewhere and those who never do."""
    groups: dict[str, list[Measured]] = {}
    for row in rows:
        source = row["person"].split("/")[0]
        who = "people who never train" if is_examinee(row["person"]) else "people who train"
        groups.setdefault(f"{source}, {who}", []).append(Measured.from_json(row["errors"]))
    return groups


def _compare_personal(rows: Sequence[Row]) -> list[Table]:
    if not rows:
        return []
    lines = [
        (
            row["person"],
            "promoted" if is_promoted(row) else row["verdict"],
            *_tell([Measured.from_json(row["errors"])], "served", "base"),
        )
        for row in rows
    ]
    for name, own in group_by_collection(rows).items():
        lines.append((name, "", *_tell(own, "served", "base")))
    title = "New people, later halves of their sequences: personal ÷ base"
    return [Table(title, ("person", "judge", *RATIO_COLUMNS), lines)]


def _tell(found: Sequence[Measured], method: str, reference: str) -> tuple[str, ...]:
    return tell_ratios(join(found).compare(method, reference))


STUDY = Study("wild", "Is it ever worse than standing still?", 1, plan, compute, tell, summarise)
