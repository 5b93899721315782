"""The recordings that studies read, loaded once in each process."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from models.data.clips import Clip, data_hash, load_clips
from models.data.splits import only_tests
from models.data.utd_mhad import SOURCE

UTD = SOURCE
COLLECTIONS = (UTD, "precog", "wmft")


@dataclass(frozen=True, slots=True)
class Place:
    """Where the recordings are.

    Attributes:
        utd: UTD-MHAD, a folder or the zip.
        more: the folder of the other collections.
    """

    utd: Path
    more: Path

    @classmethod
    def default(cls) -> "Place":
        """Look where tests and make targets look."""
        shared = Path("../shared/data")
        return cls(
            Path(os.environ.get("UTD_MHAD", shared / "utd-mhad")),
            Path(os.environ.get("MORE_PEOPLE", shared / "more-people")),
        )


@lru_cache(maxsize=8)
def read_collection(place: Place, source: str) -> tuple[Clip, ...]:
    """Give all clips of a collection."""
    path = place.utd if source == UTD else place.more / f"{source}.npz"
    return tuple(load_clips(path))


@lru_cache(maxsize=8)
def hash_collection(place: Place, source: str) -> str:
    """Name the contents of a collection."""
    return data_hash(read_collection(place, source))


def read_person(place: Place, person: str, *trials: str) -> list[Clip]:
    """Give the clips of a person ("utd-mhad/3"), of some trials or of all."""
    source, subject = person.split("/")
    return [
        clip
        for clip in read_collection(place, source)
        if clip.subject == subject and (not trials or clip.trial in trials)
    ]


def list_people(clips: Sequence[Clip]) -> list[str]:
    """Name the people of some clips, in the order of the clips."""
    return list(dict.fromkeys("/".join(clip.person) for clip in clips))


def is_examinee(person: str) -> bool:
    """Tell whether a person never trains: examinees, and who tests UTD-MHAD."""
    source, subject = person.split("/")
    return only_tests((source, subject))
