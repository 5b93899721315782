"""What is written down about who did what, and when."""

from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from uuid import UUID


class Action(StrEnum):
    """Everything that the audit log speaks of."""

    USER_CREATED = "user.created"
    USER_CHANGED = "user.changed"
    USER_EXPORTED = "user.exported"
    USER_DELETED = "user.deleted"
    KEY_CREATED = "key.created"
    KEY_REVOKED = "key.revoked"
    TRIAL_ERASED = "trial.erased"
    JOB_REQUESTED = "job.requested"
    JOB_CANCELLED = "job.cancelled"
    VERSION_PROMOTED = "version.promoted"
    VERSION_ROLLED_BACK = "version.rolled_back"


@dataclass(frozen=True, slots=True)
class Event:
    """One line of the audit log.

    Attributes:
        at: when.
        action: what was done.
        actor: id of the key that did it, None for the command line.
        key_id: the key that it was done to, None for none.
    """

    at: datetime
    action: Action
    actor: UUID | None
    key_id: UUID | None
