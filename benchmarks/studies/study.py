"""What a study is: independent units of work, each of which gives a row, and their summary."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

from app.personalize.judge import BLEND, REACHES, JudgeRule
from benchmarks.studies.bases import Recipe, find_sha256, list_recipes
from benchmarks.studies.cache import Row, make_key
from benchmarks.studies.recordings import Place, hash_collection
from benchmarks.studies.tables import Table
from models.correction import MOST_CENTRES, MOST_WINDOWS, PART, RANK, STRENGTH, WIDTH
from models.familiarity import DIRECTIONS, MOST_POINTS, FamiliarityRule
from models.training.finetune import FinetuneConfig


@dataclass(frozen=True)
class Unit:
    """One row to be.

    Attributes:
        name: unique within the study.
        base: the base that it is about; "" for none.
        person: who is measured, such as "utd-mhad/3"; "" for nobody.
        settings: everything else that decides it, as JSON can hold it.
        seconds: how long it takes on one core, about.
        personal: whether somebody's decoder is fitted.
        decided_by: what else decides the row, where it need not be in it.
    """

    name: str
    base: str = ""
    person: str = ""
    settings: Mapping[str, Any] = field(default_factory=dict)
    seconds: float = 10.0
    personal: bool = True
    decided_by: Mapping[str, Any] = field(default_factory=dict)

    @property
    def subject(self) -> str:
        """Name the person within the collection."""
        return self.person.rpartition("/")[2]

    @property
    def source(self) -> str:
        """Name the person's collection."""
        return self.person.partition("/")[0]


@dataclass(frozen=True)
class Lab:
    """What a unit is computed with: the recordings and the bases."""

    place: Place

    @cached_property
    def recipes(self) -> dict[str, Recipe]:
        """Give every base by its name."""
        return list_recipes()

    def find_base(self, name: str) -> Path:
        """Say where the file of a base is, or will be."""
        return self.recipes[name].path(self.place)

    def read_base(self, name: str) -> bytes:
        """Give the file of a base that was trained."""
        return _read(self.find_base(name))


@dataclass(frozen=True)
class Options:
    """What a run was asked for besides.

    Attributes:
        people: people to measure on in the place of the study's own.
    """

    people: tuple[str, ...] = ()


@dataclass(frozen=True)
class Study:
    """A question, and how it is answered.

    Attributes:
        name, question: for people.
        version: to be raised where the code of `compute` changes what a row says.
        plan: the units.
        compute: what a row holds, besides what names it; runs in a process of its own.
        headline: a row in a line.
        summarise: the tables, from rows alone; the first one is what a ledger of readings keeps.
        alone: whether times are measured, so that units take turns.
    """

    name: str
    question: str
    version: int
    plan: Callable[[Options], Sequence[Unit]]
    compute: Callable[[Unit, Lab], dict[str, Any]]
    headline: Callable[[Row], str]
    summarise: Callable[[Sequence[Row]], list[Table]]
    alone: bool = False


def key_of(study: Study, unit: Unit, lab: Lab) -> str | None:
    """Name a unit's row by everything that decides it; None while its base is not known."""
    sha256 = find_sha256(lab.recipes[unit.base], lab.place) if unit.base else ""
    if sha256 is None:
        return None
    return make_key(
        {
            "study": study.name,
            "version": study.version,
            "base": sha256,
            "person": unit.person,
            "settings": unit.settings,
            "data": hash_collection(lab.place, unit.source) if unit.person else None,
            "fit": describe_fit() if unit.personal else None,
            **unit.decided_by,
        }
    )


def subject_of(row: Row) -> str:
    """Name the subject of a row within the collection."""
    return str(row["person"]).rpartition("/")[2]


def describe_fit() -> dict[str, Any]:
    """Describe the settings that decide a personal version, beside clips, base and seed."""
    config = asdict(FinetuneConfig())
    return {
        "finetuning": config | {"rates": dict(config["rates"])},
        "judge": asdict(JudgeRule()),
        "blend": BLEND,
        "reaches": REACHES,
        "gate": asdict(FamiliarityRule()) | {"directions": DIRECTIONS, "points": MOST_POINTS},
        "correction": {
            "width": WIDTH,
            "strength": STRENGTH,
            "rank": RANK,
            "part": PART,
            "centres": MOST_CENTRES,
            "windows": MOST_WINDOWS,
        },
    }


@lru_cache(maxsize=8)
def _read(path: Path) -> bytes:
    return path.read_bytes()
