"""What the service remembers of open streams: just enough to fence and to close them."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Any
from uuid import UUID

from app.domain.jobs import JobState


@dataclass(frozen=True, slots=True)
class OpenStream:
    """One open stream, as the database has to judge it.

    Attributes:
        user_uuid: whose stream it is.
        key_id: the key that opened it.
        session: its name, unique per user.
        epoch: how often that name was opened, this time included.
    """

    user_uuid: UUID
    key_id: UUID
    session: str
    epoch: int


class Verdict(StrEnum):
    """Why an open stream must close."""

    USER_DELETED = "user_deleted"
    KEY_REVOKED = "key_revoked"
    FENCED = "fenced"


@dataclass(frozen=True, slots=True)
class JobNews:
    """How a fine-tuning job stands, as its user's streams are told.

    Attributes:
        id: which job.
        user_uuid: whose.
        state: where it stands.
        progress: the newest of what the training tells, None before.
        metrics: the figures of the version that it made, None where there is none.
    """

    id: UUID
    user_uuid: UUID
    state: JobState
    progress: dict[str, Any] | None
    metrics: dict[str, Any] | None
