"""What the service remembers of open streams: just enough to fence and to close them."""

from dataclasses import dataclass
from enum import StrEnum
from uuid import UUID


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
