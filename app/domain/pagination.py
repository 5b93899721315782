"""Lists in pages, newest first."""

import base64
import binascii
import struct
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Generic, NamedTuple, TypeVar
from uuid import UUID

from app.domain.errors import FieldError, InvalidError

DEFAULT_PAGE = 50
MAX_PAGE = 200
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_MICROSECOND = timedelta(microseconds=1)
_LAYOUT = ">q16s"

Item = TypeVar("Item")


class Cursor(NamedTuple):
    """Where a page ended: the instant and id of its last row."""

    created_at: datetime
    id: UUID

    def encode(self) -> str:
        """Write the cursor as the text that clients hand back, opaque to them."""
        micros = (self.created_at - _EPOCH) // _MICROSECOND
        return base64.urlsafe_b64encode(struct.pack(_LAYOUT, micros, self.id.bytes)).decode()


def decode_cursor(text: str) -> Cursor:
    """Read a cursor.

    Raises:
        InvalidError: the text was not given out by ``Cursor.encode``.
    """
    try:
        raw = base64.b64decode(text.encode("ascii"), altchars=b"-_", validate=True)
        micros, key = struct.unpack(_LAYOUT, raw)
        return Cursor(_EPOCH + micros * _MICROSECOND, UUID(bytes=key))
    except (binascii.Error, struct.error, ValueError, OverflowError):
        wrong = FieldError(("query", "cursor"), "not a cursor of this list")
        raise InvalidError("The cursor is not one of this list.", errors=(wrong,)) from None


@dataclass(frozen=True, slots=True)
class Page(Generic[Item]):
    """Some rows of a list, and where to go on; None at the end."""

    items: list[Item]
    next_cursor: str | None
