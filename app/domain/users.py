"""The people whose motion is forecast."""

import hashlib
import hmac
import re
from dataclasses import dataclass
from datetime import datetime
from typing import Literal
from uuid import UUID

UpAxis = Literal["y", "-y", "z"]
LIVED_MAX_S = 600.0
"""What was seen counts for this long at most, so that what is seen next can still change it."""

USER_ID_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$"
"""User ids are chosen by the operator, and case-sensitive."""


@dataclass(frozen=True, slots=True)
class User:
    """One person.

    Attributes:
        uuid: what all rows of the person hang on. It is new whenever an id is created again, so
            a re-created id never meets old data.
        id: the operator's name for the person.
        skeleton: name of the skeleton format that the person's poses come in.
        up: which axis of those poses points up.
        root_relative: whether the sensor gives positions relative to the hips only.
        display_name: free text for people, None if not given.
        created_at: when the row was made.
        auto_promote: whether a version that wins becomes active by itself.
    """

    uuid: UUID
    id: str
    skeleton: str
    up: UpAxis
    root_relative: bool
    display_name: str | None
    created_at: datetime
    auto_promote: bool = True


@dataclass(frozen=True, slots=True)
class Lived:
    """Whose body was seen on a user's streams.

    Attributes:
        bones: as `app.domain.body.measure_bones` gives them.
        seconds: how long it was seen.
    """

    bones: tuple[float, ...]
    seconds: float

    def join(self, newer: "Lived") -> "Lived":
        """Blend in what was seen later, by seconds."""
        seconds = self.seconds + newer.seconds
        share = newer.seconds / seconds
        pairs = zip(self.bones, newer.bones, strict=True)
        bones = tuple((1 - share) * old + share * new for old, new in pairs)
        return Lived(bones, min(seconds, LIVED_MAX_S))


def may_be_user_id(text: str) -> bool:
    """Tell whether a text can be a user id; of others a database may not even take the text."""
    return re.fullmatch(USER_ID_PATTERN, text) is not None


def pseudonym(user_id: str, *, key: bytes) -> str:
    """Give what the audit log keeps of an erased user: the HMAC-SHA-256 of the id, in hex."""
    return hmac.new(key, user_id.encode(), hashlib.sha256).hexdigest()
