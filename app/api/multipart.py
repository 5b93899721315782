"""`multipart/form-data`, read from a body that is in memory as a whole."""

from dataclasses import dataclass
from email.message import Message
from email.parser import HeaderParser

from app.domain.errors import BadMessageError

MAX_PARTS = 1000


@dataclass(frozen=True, slots=True)
class Part:
    """One part of a form.

    Attributes:
        name: of the field.
        filename: of the file, None where the part is none.
        content: its bytes.
    """

    name: str
    filename: str | None
    content: bytes


def parse_form(content_type: str, body: bytes) -> list[Part]:
    """Read the parts of a form, in order (RFC 7578).

    Raises:
        BadMessageError: it is no such form.
    """
    about = Message()
    about["Content-Type"] = content_type
    boundary = about.get_param("boundary")
    if not isinstance(boundary, str) or not boundary:
        raise BadMessageError("The form has no boundary.")
    delimiter = b"\r\n--" + boundary.encode("latin-1", errors="replace")
    pieces = (b"\r\n" + body).split(delimiter, MAX_PARTS + 2)
    if len(pieces) < 2 or not pieces[-1].startswith(b"--"):
        raise BadMessageError("The form is cut off, or has too many parts.")
    return [_parse_part(piece) for piece in pieces[1:-1]]


def _parse_part(piece: bytes) -> Part:
    head, found, content = piece.partition(b"\r\n\r\n")
    if not found:
        raise BadMessageError("A part of the form has no header.")
    headers = HeaderParser().parsestr(head.strip().decode("utf-8", errors="replace"))
    name = headers.get_param("name", header="content-disposition")
    if not isinstance(name, str):
        raise BadMessageError("A part of the form has no name.")
    return Part(name, headers.get_filename(), content)
