"""What a session needs to know of its stream, and what it asks the route to do."""

from dataclasses import dataclass

from msgspec import Struct

from app.domain.errors import KinecastError
from app.live.protocol import Bye, ErrorMessage, ServerMessage
from app.live.steps import Step
from app.live.window import WindowReady
from app.live.work import EngineRequest
from models.skeleton import Skeleton


@dataclass(frozen=True, slots=True)
class Identity:
    """Whose stream it is.

    Attributes:
        user: id of the user.
        skeleton, up, root_relative: how that user's poses come.
        session: name of the session.
        epoch: how often that name was opened.
        may_record: whether the key has the scope `record`.
    """

    user: str
    skeleton: Skeleton
    up: str
    root_relative: bool
    session: str
    epoch: int
    may_record: bool


class Send(Struct, frozen=True):
    """Send a message; none of these may be lost."""

    message: ServerMessage


class Ticket(Struct, frozen=True):
    """A window on its way through the engine, and the frame that it came from.

    Attributes:
        seq: number of the frame.
        ready: the window.
        flags: quality flags of how the frame came.
        born: when it was captured, as far as was known on its arrival; server's clock, seconds.
        turn: how often the weights had changed when it was asked for.
    """

    seq: int
    ready: WindowReady
    flags: tuple[str, ...]
    born: float
    turn: int = 0


class Submit(Struct, frozen=True):
    """Have a window forecast; hand the ticket back with the result."""

    request: EngineRequest
    ticket: Ticket


@dataclass(frozen=True, slots=True)
class End:
    """Tell the client why, and close."""

    error: KinecastError


@dataclass(frozen=True, slots=True)
class Store:
    """Carry out a step of a recording, beside everything else; tell the session what came of it."""

    step: Step


Action = Send | Submit | Store | End


def describe(error: KinecastError, seq: int | None = None) -> ErrorMessage:
    """Write an error as a message."""
    return ErrorMessage(error.code, error.message, error.retryable, seq)


def take_leave(error: KinecastError) -> Bye:
    """Write the last message before a close."""
    retry_after_s = getattr(error, "retry_after_s", 1.0 if error.retryable else 0.0)
    return Bye(error.code, float(retry_after_s))
