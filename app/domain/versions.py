"""Versions of a person's decoder: their states, when one becomes active, and which are kept."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from typing import Any
from uuid import UUID

BASE_NUMBER = 0
"""What the shared base is called among the versions of every user."""


class VersionState(StrEnum):
    """Where a version stands; ``meaning`` says it to people."""

    CANDIDATE = "candidate"
    ACTIVE = "active"
    RETIRED = "retired"
    REJECTED = "rejected"

    @property
    def meaning(self) -> str:
        """What the state says, in one sentence."""
        return _MEANINGS[self]

    def may_become(self, later: "VersionState") -> bool:
        """Tell whether a version may go from this state to the other one."""
        return later in MOVES[self]


_MEANINGS = {
    VersionState.CANDIDATE: "It won, and waits for somebody to promote it.",
    VersionState.ACTIVE: "It answers whoever asks for nothing else; there is at most one.",
    VersionState.RETIRED: "It was active before.",
    VersionState.REJECTED: "It did not win; its figures are kept.",
}

MOVES: dict[VersionState, frozenset[VersionState]] = {
    VersionState.CANDIDATE: frozenset({VersionState.ACTIVE}),
    VersionState.ACTIVE: frozenset({VersionState.RETIRED}),
    VersionState.RETIRED: frozenset({VersionState.ACTIVE}),
    # Only by hand: an operator may know better than the judge.
    VersionState.REJECTED: frozenset({VersionState.ACTIVE}),
}
"""Every move that a version may make; it is born as candidate, active or rejected."""


class Verdict(StrEnum):
    """What the judge says of a candidate; `RETURN_TO_BASE` also of what is active."""

    PROMOTE = "promote"
    REJECT = "reject"
    RETURN_TO_BASE = "return_to_base"
    TOO_LITTLE_DATA = "too_little_data"


@dataclass(frozen=True, slots=True)
class Version:
    """One version, without its weights.

    Attributes:
        number: counts from 1 for each user and is never used again.
        state: where it stands.
        parent: the version that was active when it was trained, 0 for the base.
        base_sha256: the base whose encoder it runs on.
        sha256: hex digest of its weights.
        size: bytes of its weights.
        purged: whether the weights were removed; then only the figures are left.
        trained_on: the trials.
        metrics: the judge's figures.
        job_id: the job that made it.
        created_at: when it was made.
        activated_at: when it last became active, None if never.
    """

    number: int
    state: VersionState
    parent: int
    base_sha256: str
    sha256: str
    size: int
    purged: bool
    trained_on: tuple[UUID, ...]
    metrics: dict[str, Any]
    job_id: UUID | None
    created_at: datetime
    activated_at: datetime | None


class ActivationKind(StrEnum):
    """How a version came to be the active one."""

    PROMOTED = "promoted"
    BY_HAND = "by_hand"
    ROLLED_BACK = "rolled_back"
    WITHDRAWN = "withdrawn"


@dataclass(frozen=True, slots=True)
class Activation:
    """One line of the history of what was active.

    Attributes:
        number: what became active, 0 for the base.
        kind: how.
    """

    number: int
    kind: ActivationKind


@dataclass(frozen=True, slots=True)
class ActiveVersion:
    """What answers a user now.

    Attributes:
        number: 0 for the base.
        sha256: of its weights, None for the base.
        base_sha256: the base that it runs on, None for the base itself.
    """

    number: int = BASE_NUMBER
    sha256: str | None = None
    base_sha256: str | None = None


@dataclass(frozen=True, slots=True)
class Standing:
    """What is known of a user when a candidate asks to become active.

    Attributes:
        auto_promote: whether versions may become active by themselves; a promotion or a rollback
            by hand turns that off.
        active: number of the active version, 0 for the base.
        rolled_back: digests of weights that were once active and taken back.
    """

    auto_promote: bool
    active: int
    rolled_back: frozenset[str]


def may_promote(verdict: Verdict, standing: Standing, *, parent: int, sha256: str) -> bool:
    """Tell whether a candidate becomes active by itself.

    It must have won against what is active now, and may not be what was taken back before.

    Args:
        verdict: the judge's.
        standing: of the user, at this moment.
        parent: the version that was active when the candidate was judged.
        sha256: of the candidate.
    """
    return (
        verdict is Verdict.PROMOTE
        and standing.auto_promote
        and standing.active == parent
        and sha256 not in standing.rolled_back
    )


def must_withdraw(verdict: Verdict, standing: Standing, *, parent: int) -> bool:
    """Tell whether the active version gives way to the base by itself.

    It is not touched where somebody promoted by hand, nor if it is another one than was judged.

    Args:
        verdict: the judge's.
        standing: of the user, at this moment.
        parent: the version that was active when the trials were judged.
    """
    return (
        verdict is Verdict.RETURN_TO_BASE
        and standing.auto_promote
        and standing.active == parent != BASE_NUMBER
    )


def find_rollback(history: Sequence[Activation], *, usable: Callable[[int], bool]) -> int:
    """Find where a rollback leads: the newest earlier activation that was not itself rolled back.

    Args:
        history: everything that was ever active, oldest first.
        usable: whether a version still has its weights.

    Returns:
        The number of the version, 0 where there is none to go back to.
    """
    before = list_standing(history)[:-1]
    return next((number for number in reversed(before) if usable(number)), BASE_NUMBER)


def list_standing(history: Iterable[Activation]) -> list[int]:
    """List the activations that were not rolled back, oldest first; the last one is active.

    A rollback takes back activations until the one that it names is the newest again.
    """
    standing: list[int] = []
    for line in history:
        if line.kind is not ActivationKind.ROLLED_BACK:
            standing.append(line.number)
            continue
        standing = standing[:-1]
        while standing and standing[-1] != line.number:
            standing.pop()
    return standing


def list_purgeable(versions: Iterable[Version], *, active: int, keep: int) -> list[int]:
    """List the versions whose weights may be removed, oldest first.

    Args:
        versions: all of a user's.
        active: number of the active one, 0 for the base.
        keep: how many of the newest keep their weights in any case.

    Returns:
        Numbers; never the active one nor its parent.
    """
    ordered = sorted(versions, key=lambda version: version.number)
    parents = {version.parent for version in ordered if version.number == active}
    newest = {version.number for version in ordered[len(ordered) - keep :]} if keep else set()
    kept = {active} | parents | newest
    return [v.number for v in ordered if not v.purged and v.number not in kept]
