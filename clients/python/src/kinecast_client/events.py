"""What a stream tells besides forecasts: its own news, and messages of the service."""

from dataclasses import dataclass

from kinecast_client.errors import StoppedError
from kinecast_client.messages import (
    Configured,
    Hello,
    JobNews,
    ServiceError,
    TrialNews,
    VersionChanged,
    Waiting,
)


@dataclass(frozen=True, slots=True)
class Connected:
    """A connection is open, the first one or another."""

    hello: Hello


@dataclass(frozen=True, slots=True)
class Disconnected:
    """The connection broke, or could not be made; the stream tries again by itself.

    Attributes:
        close_code: of the WebSocket; 1006 where it broke without one.
        reason: what happened, for people.
        retry_in_s: how long the stream waits before it tries again.
    """

    close_code: int
    reason: str
    retry_in_s: float


@dataclass(frozen=True, slots=True)
class Stopped:
    """The stream ended for good."""

    error: StoppedError


Event = (
    Connected
    | Disconnected
    | Stopped
    | Waiting
    | Configured
    | ServiceError
    | VersionChanged
    | TrialNews
    | JobNews
)
