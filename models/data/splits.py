"""Who trains, who is tested, and who is kept for the examination."""

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from models.data.clips import Clip
from models.data.utd_mhad import SOURCE

TRAIN_SUBJECTS = ("1", "3", "5", "7")
"""Subjects of UTD-MHAD on which the base is trained, and on which every choice is made."""
TEST_SUBJECTS = ("2", "4", "6")
"""Subjects of UTD-MHAD that only `evaluate` reads."""
PERSONAL_TRIAL = "1"
TEST_TRIALS = ("2", "3", "4")

EXAMINATION: frozenset[tuple[str, str]] = frozenset(
    {("precog", str(n)) for n in range(7, 10)} | {("wmft", str(n)) for n in range(15, 20)}
)
"""People (source, subject) of the permissive collections that never train."""


@dataclass(frozen=True, slots=True)
class Split:
    """Clips to fit on and clips to judge by; no clip is in both."""

    train: list[Clip]
    held_out: list[Clip]


def select(
    clips: Iterable[Clip],
    *,
    subjects: Collection[str] | None = None,
    trials: Collection[str] | None = None,
) -> list[Clip]:
    """Keep the clips of some subjects and trials, in their order; None keeps all."""
    return [
        clip
        for clip in clips
        if (subjects is None or clip.subject in subjects)
        and (trials is None or clip.trial in trials)
    ]


def only_tests(person: tuple[str, str]) -> bool:
    """Tell whether somebody, (source, subject), is kept for tests and so never trains."""
    source, subject = person
    if source == SOURCE:
        return subject not in TRAIN_SUBJECTS
    return person in EXAMINATION


def without_examination(clips: Iterable[Clip]) -> list[Clip]:
    """Drop the people who never train."""
    return [clip for clip in clips if not only_tests(clip.person)]


def split_by_person(clips: Iterable[Clip], held_out: Collection[tuple[str, str]]) -> Split:
    """Set aside every clip of some people, given as (source, subject).

    Raises:
        ValueError: if one of them has no clip, so that a misspelt name does not pass for a test.
    """
    clips = list(clips)
    missing = set(held_out) - {clip.person for clip in clips}
    if missing:
        raise ValueError(f"no clips of {sorted(missing)}")
    return Split(
        train=[clip for clip in clips if clip.person not in held_out],
        held_out=[clip for clip in clips if clip.person in held_out],
    )


def leave_people_out(clips: Sequence[Clip]) -> Iterator[tuple[tuple[str, str], Split]]:
    """Leave each person out in turn, in a fixed order: (source, subject) and the split.

    Raises:
        ValueError: with fewer than two people.
    """
    people = sorted({clip.person for clip in clips})
    if len(people) < 2:
        raise ValueError(f"leaving people out needs at least two of them, got {people}")
    for person in people:
        yield person, split_by_person(clips, [person])


def split_by_clip(clips: Sequence[Clip], *, share: float, seed: int) -> Split:
    """Set aside a random share of whole clips, at least one, in equal parts from every person.

    Windows of one clip overlap, so a split by window would test on what was trained on.

    Args:
        clips: the clips to split; their order is kept in both parts.
        share: between 0 and 1.
        seed: the same seed gives the same split.

    Raises:
        ValueError: if `share` is not between 0 and 1, or somebody has only one clip.
    """
    if not 0 < share < 1:
        raise ValueError(f"share must lie between 0 and 1, got {share}")
    random = np.random.default_rng(seed)
    held_out: set[int] = set()
    for person in sorted({clip.person for clip in clips}):
        own = [index for index, clip in enumerate(clips) if clip.person == person]
        if len(own) < 2:
            raise ValueError(f"cannot split the only clip of {person}")
        count = min(len(own) - 1, max(1, round(share * len(own))))
        held_out.update(int(index) for index in random.choice(own, size=count, replace=False))
    return Split(
        train=[clip for index, clip in enumerate(clips) if index not in held_out],
        held_out=[clip for index, clip in enumerate(clips) if index in held_out],
    )
