"""What a recording asks of the database, and what comes back: plain values.

A step is tried again after an outage whose end nobody saw, so whoever carries one out must make
the second time change nothing.
"""

from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from uuid import UUID

from app.domain.trials import TrialState
from app.live.protocol import JobNote, Observation


@dataclass(frozen=True, slots=True)
class Begin:
    """Begin a trial, or go on with it if it was begun before."""

    trial: UUID
    label: str | None


@dataclass(frozen=True, slots=True)
class Resume:
    """Go on with a trial after a reconnect."""

    trial: UUID


@dataclass(frozen=True, slots=True, eq=False)
class Portion:
    """Some frames of a clip.

    Attributes:
        clip: ordinal of the clip within the trial.
        action: what the person does.
        seconds: how long the clip is with them.
        frames: as received.
    """

    clip: int
    action: str | None
    seconds: float
    frames: tuple[Observation, ...]

    @property
    def stored_seq(self) -> int:
        """The newest frame of it."""
        return self.frames[-1].seq


@dataclass(frozen=True, slots=True, eq=False)
class Append:
    """Store frames, all of them or none."""

    portions: tuple[Portion, ...]


@dataclass(frozen=True, slots=True)
class Touch:
    """Say that the stream is still there."""


@dataclass(frozen=True, slots=True)
class Finish:
    """Look at the clips, complete the trial, and ask for a job if one is wanted."""

    finetune: bool


@dataclass(frozen=True, slots=True)
class Cancel:
    """Throw the trial away."""


Step = Begin | Resume | Append | Touch | Finish | Cancel


@dataclass(frozen=True, slots=True)
class LastClip:
    """The clip with which a recording left off.

    Attributes:
        ordinal: its place within the trial.
        action: what the person did.
        frames: how many frames of it are stored.
        first_t, last_t: times of the first and the newest of them, seconds on the client's clock.
    """

    ordinal: int
    action: str | None
    frames: int
    first_t: float
    last_t: float


@dataclass(frozen=True, slots=True)
class Opened:
    """A recording may be written to.

    Attributes:
        stored_seq: the newest frame that is stored, None for none.
        frames: how many are.
        clips: how many ordinals of clips were given away.
        last: the last clip, None if there is none.
    """

    stored_seq: int | None = None
    frames: int = 0
    clips: int = 0
    last: LastClip | None = None


@dataclass(frozen=True, slots=True)
class Finished:
    """A trial is complete; `job` will train on it, if one was asked for."""

    job: JobNote | None


@dataclass(frozen=True, slots=True)
class Over:
    """The trial that was to be opened has ended, on a stream that did not hear of it.

    Attributes:
        state: stored or cancelled.
        stored_seq: the newest frame of it.
        job: what trains on it, None if nothing does.
    """

    state: TrialState
    stored_seq: int | None
    job: JobNote | None


@dataclass(frozen=True, slots=True)
class Done:
    """The step was carried out, and there is nothing to say of it."""


Outcome = Opened | Over | Finished | Done
Archive = Callable[[Step], Awaitable[Outcome]]
"""Carries steps out, one at a time. Raises NotReadyError where it may be tried again, FencedError
and UserDeletedError where the stream must end, and other KinecastErrors where the recording must.
"""
