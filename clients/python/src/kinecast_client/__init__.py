"""Forecasts of human motion for a robot's program: the client of a Kinecast service."""

from kinecast_client.async_client import AsyncClient
from kinecast_client.async_stream import AsyncRecording, AsyncStream
from kinecast_client.client import Client
from kinecast_client.errors import (
    AnswerError,
    ApiError,
    BusyError,
    ConflictError,
    DeadlineError,
    FencedError,
    ForbiddenError,
    FrameError,
    InvalidError,
    KinecastError,
    NotFoundError,
    RecordingError,
    RefusedError,
    StoppedError,
    UnauthorizedError,
    UnreachableError,
    UserDeletedError,
)
from kinecast_client.events import Connected, Disconnected, Event, Stopped
from kinecast_client.forecasts import Forecast, Timing, Version
from kinecast_client.messages import (
    Configured,
    Hello,
    JobNews,
    ServiceError,
    TrialNews,
    VersionChanged,
    Waiting,
)
from kinecast_client.recordings import RecordingStatus
from kinecast_client.statistics import Spread, Statistics
from kinecast_client.stream import Recording, Stream
from kinecast_client.values import (
    Clip,
    ClipReport,
    Job,
    PersonalVersion,
    StoredTrial,
    Trial,
    User,
)

__all__ = [
    "AnswerError",
    "ApiError",
    "AsyncClient",
    "AsyncRecording",
    "AsyncStream",
    "BusyError",
    "Client",
    "Clip",
    "ClipReport",
    "Configured",
    "ConflictError",
    "Connected",
    "DeadlineError",
    "Disconnected",
    "Event",
    "FencedError",
    "ForbiddenError",
    "Forecast",
    "FrameError",
    "Hello",
    "InvalidError",
    "Job",
    "JobNews",
    "KinecastError",
    "NotFoundError",
    "PersonalVersion",
    "Recording",
    "RecordingError",
    "RecordingStatus",
    "RefusedError",
    "ServiceError",
    "Spread",
    "Statistics",
    "Stopped",
    "StoppedError",
    "StoredTrial",
    "Stream",
    "Timing",
    "Trial",
    "TrialNews",
    "UnauthorizedError",
    "UnreachableError",
    "User",
    "UserDeletedError",
    "Version",
    "VersionChanged",
    "Waiting",
]
