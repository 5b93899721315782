"""Fine-tuning jobs: their states, who is next, and when to try again.

The database is the queue. A worker holds a job by a lease that it renews, and by a fence, a number
that grows with every claim: whoever comes back after its lease ran out has an old fence, and
nothing that it writes is accepted.
"""

from dataclasses import dataclass
from datetime import datetime, timedelta
from enum import StrEnum
from typing import Any, NamedTuple
from uuid import UUID

MAX_ATTEMPTS = 3
"""A job that ended three workers, or failed three times, would do so again."""
FIRST_RETRY_S = 5.0
LONGEST_RETRY_S = 300.0


class JobState(StrEnum):
    """Where a job stands; ``meaning`` says it to people."""

    QUEUED = "queued"
    RUNNING = "running"
    SUCCEEDED = "succeeded"
    REJECTED = "rejected"
    FAILED = "failed"
    CANCELLED = "cancelled"

    @property
    def meaning(self) -> str:
        """What the state says, in one sentence."""
        return _MEANINGS[self]

    @property
    def is_final(self) -> bool:
        """Whether nothing happens any more."""
        return not MOVES[self]

    def may_become(self, later: "JobState") -> bool:
        """Tell whether a job may go from this state to the other one."""
        return later in MOVES[self]


_MEANINGS = {
    JobState.QUEUED: "It waits for a worker.",
    JobState.RUNNING: "A worker has it, or had it and will be followed by another.",
    JobState.SUCCEEDED: "It made a version that was good enough.",
    JobState.REJECTED: "What it made did not win, or there was too little to learn from.",
    JobState.FAILED: "It was tried as often as makes sense.",
    JobState.CANCELLED: "Somebody called it off.",
}

MOVES: dict[JobState, frozenset[JobState]] = {
    JobState.QUEUED: frozenset({JobState.RUNNING, JobState.CANCELLED}),
    # A running job is taken over in place: back in the queue it could meet the next of its user.
    JobState.RUNNING: frozenset(
        {
            JobState.RUNNING,
            JobState.SUCCEEDED,
            JobState.REJECTED,
            JobState.FAILED,
            JobState.CANCELLED,
        }
    ),
    JobState.SUCCEEDED: frozenset(),
    JobState.REJECTED: frozenset(),
    JobState.FAILED: frozenset(),
    JobState.CANCELLED: frozenset(),
}
"""Every move that a job may make."""


class JobReason(StrEnum):
    """Why a job is in its state; while it waits and runs, why there is one."""

    TRIAL = "trial"
    REQUEST = "request"
    NEW_BASE = "new_base"
    PROMOTED = "promoted"
    AWAITS_PROMOTION = "awaits_promotion"
    DID_NOT_WIN = "did_not_win"
    TOO_LITTLE_DATA = "too_little_data"
    ERROR = "error"
    CANCELLED = "cancelled"


@dataclass(frozen=True, slots=True)
class Job:
    """One job.

    Attributes:
        id: its own.
        user: id of the person.
        state: where it stands.
        reason: why it is there.
        trials: what it trains on: the explicit list, or what was stored when it started; None
            while that is not known.
        explicit: whether the list was given, so that nothing may join it.
        requested_by: the key that asked for it, None for the service itself.
        attempt: how often a worker took it.
        progress: the newest of what the training tells, None before.
        message: the end, or the last error, for an operator.
        cancelling: whether somebody called it off and its worker does not know yet.
        created_at, started_at, finished_at: when; None if not yet.
        version: number of the version that it made, None for none.
    """

    id: UUID
    user: str
    state: JobState
    reason: JobReason
    trials: tuple[UUID, ...] | None
    explicit: bool
    requested_by: UUID | None
    attempt: int
    progress: dict[str, Any] | None
    message: str | None
    cancelling: bool
    created_at: datetime
    started_at: datetime | None
    finished_at: datetime | None
    version: int | None


@dataclass(frozen=True, slots=True)
class Claim:
    """The right to work on a job, for as long as nobody else claims it.

    Attributes:
        job_id: which.
        user_uuid: whose.
        fence: which claim of the job this is; only the newest may write.
        attempt: how often a worker took it, this time included.
        trials: what to train on, oldest first.
        cancelled: whether it was called off before; then there is nothing to do but to say so.
    """

    job_id: UUID
    user_uuid: UUID
    fence: int
    attempt: int
    trials: tuple[UUID, ...]
    cancelled: bool = False


def retry_after(attempt: int) -> timedelta | None:
    """Tell how long to wait after a failed attempt; None if there is no other.

    Args:
        attempt: which one failed, from 1.
    """
    if attempt >= MAX_ATTEMPTS:
        return None
    return timedelta(seconds=min(FIRST_RETRY_S * 4.0 ** (attempt - 1), LONGEST_RETRY_S))


class Turn(NamedTuple):
    """What decides who is next; compares as the queue is ordered.

    Attributes:
        is_refit: whether nobody waits for it, because only the base is another one.
        was_served: whether the user ever had a turn.
        served_at: when, None if never; who waited longest comes first.
        created_at: when the job was made.
        id: so that the order is never open.
    """

    is_refit: bool
    was_served: bool
    served_at: datetime | None
    created_at: datetime
    id: UUID


def fair_order(
    *,
    served_at: datetime | None,
    created_at: datetime,
    job_id: UUID,
    reason: JobReason = JobReason.TRIAL,
) -> Turn:
    """Give the key by which jobs are served: whose user waited longest, then the oldest.

    So a user who records all day is one voice among the others. A new base, for which everybody
    is fitted again, holds nobody up who recorded something.
    """
    is_refit = reason is JobReason.NEW_BASE
    return Turn(is_refit, served_at is not None, served_at, created_at, job_id)
