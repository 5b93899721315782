"""Trials: what a person was recorded doing, and what became of each clip of it."""

from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from uuid import UUID


class TrialState(StrEnum):
    """Where a trial stands; ``meaning`` says it to people."""

    RECORDING = "recording"
    STORED = "stored"
    CANCELLED = "cancelled"

    @property
    def meaning(self) -> str:
        """What the state says, in one sentence."""
        return _MEANINGS[self]

    def may_become(self, later: "TrialState") -> bool:
        """Tell whether a trial may go from this state to the other one."""
        return later in MOVES[self]


_MEANINGS = {
    TrialState.RECORDING: "A stream is adding frames to it.",
    TrialState.STORED: "It is complete, and never changes again.",
    TrialState.CANCELLED: "Its recording was called off; it is trained on by nobody.",
}

MOVES: dict[TrialState, frozenset[TrialState]] = {
    TrialState.RECORDING: frozenset({TrialState.STORED, TrialState.CANCELLED}),
    TrialState.STORED: frozenset(),
    TrialState.CANCELLED: frozenset(),
}
"""Every move that a trial may make. Erasing one is no state: then it was never there."""


class TrialSource(StrEnum):
    """How the frames of a trial came in."""

    UPLOAD = "upload"
    STREAM = "stream"


class ClipFlaw(StrEnum):
    """Why a clip is kept and not trained on."""

    TOO_SHORT = "too_short"
    FROZEN = "frozen_input"
    NOISY = "noisy"
    MIRRORED = "mirrored"
    IMPLAUSIBLE_POSE = "implausible_pose"
    IMPLAUSIBLE_UNITS = "implausible_units"
    UPSIDE_DOWN = "upside_down"
    NOT_THIS_PERSON = "not_this_person"
    PERSON_LOST = "person_lost"

    @property
    def meaning(self) -> str:
        """What an operator can do about it, in one sentence."""
        return _FLAWS[self]


_FLAWS = {
    ClipFlaw.TOO_SHORT: "It is too short to hold one window of a second.",
    ClipFlaw.FROZEN: "The sensor repeated the same pose.",
    ClipFlaw.NOISY: "Joints jump from frame to frame as no body can.",
    ClipFlaw.MIRRORED: "Left and right are swapped.",
    ClipFlaw.IMPLAUSIBLE_POSE: "The joints are in another order, or jump through the room.",
    ClipFlaw.IMPLAUSIBLE_UNITS: "The torso is no human's: are these metres?",
    ClipFlaw.UPSIDE_DOWN: "The head is below the hips: is `up` right?",
    ClipFlaw.NOT_THIS_PERSON: "The bones are not as long as in this person's earlier trials.",
    ClipFlaw.PERSON_LOST: "The hips, or most joints, were not seen for a second at a time.",
}


@dataclass(frozen=True, slots=True)
class ClipInfo:
    """One clip of a trial, without its frames.

    Attributes:
        ordinal: its place within the trial, from 0.
        action: what the person did, as the client calls it; None if it said nothing.
        frames: how many were received.
        seconds: from the first to the last of them.
        flaw: why it is not trained on, None if it may be.
    """

    ordinal: int
    action: str | None
    frames: int
    seconds: float
    flaw: ClipFlaw | None

    @property
    def used(self) -> bool:
        """Whether it may be trained on."""
        return self.flaw is None


@dataclass(frozen=True, slots=True)
class Trial:
    """One trial, without its frames.

    Attributes:
        id: its own.
        user: id of the person.
        label: free text of the client.
        state: where it stands.
        source: how its frames came in.
        finetune: whether storing it asks for a job.
        clips: what it consists of, in order.
        created_at: when it began.
        stored_at: when it was complete, None before.
    """

    id: UUID
    user: str
    label: str | None
    state: TrialState
    source: TrialSource
    finetune: bool
    clips: tuple[ClipInfo, ...]
    created_at: datetime
    stored_at: datetime | None

    @property
    def frames(self) -> int:
        """How many frames were received."""
        return sum(clip.frames for clip in self.clips)

    @property
    def seconds(self) -> float:
        """How long the clips are together."""
        return sum((clip.seconds for clip in self.clips), 0.0)
