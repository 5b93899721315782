"""The messages of a stream: one set of structs for both subprotocols.

`app.live.codec` turns them into JSON and msgpack and back. Nothing here knows what a stream does
with a message.
"""

from dataclasses import dataclass
from typing import Annotated, Any, Literal, get_args
from uuid import UUID

import numpy as np
from jaxtyping import Float
from msgspec import UNSET, Meta, Raw, Struct, UnsetType

from app.domain.errors import KinecastError
from app.domain.limits import Limits
from app.domain.motion import RequestedVersion, Severity, Timing, VersionStamp

PROTOCOL = 1
JSON = "kinecast.v1.json"
MSGPACK = "kinecast.v1.msgpack"
SUBPROTOCOLS = (MSGPACK, JSON)
"""In the order of preference, where a client offers both."""

Seq = Annotated[int, Meta(ge=0, le=2**53 - 1)]
ForecastEvery = Annotated[int, Meta(ge=1, le=600)]
Coverage = Annotated[float, Meta(gt=0, lt=1)]
VersionNumber = Annotated[int, Meta(ge=0, le=2**31 - 1)]
MaxAgeMs = Annotated[float, Meta(gt=0, le=60_000)]
Label = Annotated[str, Meta(min_length=1, max_length=200, pattern=r"^[^\x00-\x1f\x7f-\x9f]*\Z")]
PingId = Annotated[int, Meta(ge=-(2**53), le=2**53)] | Annotated[str, Meta(max_length=64)]


class _Client(Struct, tag_field="type", forbid_unknown_fields=True):
    """Base of what clients send: a misspelt field must not pass."""


class Auth(_Client, tag="auth"):
    """The key, as the very first message, from clients that cannot set a header."""

    key: Annotated[str, Meta(max_length=1024)]


class Frame(_Client, tag="frame"):
    """One frame as it came; `joints` and `confidence` still in the wire's form."""

    seq: Seq
    t: float
    joints: Raw
    confidence: Raw = Raw()
    replay: bool = False


class Configure(_Client, tag="configure"):
    """Change how forecasts are made; what is absent stays as it is."""

    forecast_every: ForecastEvery | UnsetType = UNSET
    coverage: Coverage | UnsetType = UNSET
    version: Literal["active", "base"] | VersionNumber | UnsetType = UNSET
    max_age_ms: MaxAgeMs | UnsetType = UNSET


class Reset(_Client, tag="reset"):
    """Forget the window: the frame of reference jumped."""


class Ping(_Client, tag="ping"):
    """A sign of life, with the client's time."""

    id: PingId
    t: float


class ClientPong(_Client, tag="pong"):
    """The client's answer to `ServerPing`: its own time beside what the server sent."""

    id: PingId
    server_t: float
    t: float


class TrialStart(_Client, tag="trial.start"):
    """Begin a recording, and its first clip."""

    trial: UUID | None = None
    label: Label | None = None


class ClipStart(_Client, tag="clip.start"):
    """Begin a clip within a recording."""

    action: Label | None = None


class ClipStop(_Client, tag="clip.stop"):
    """End the clip."""


class TrialStop(_Client, tag="trial.stop"):
    """End the recording."""

    finetune: bool = True


class TrialCancel(_Client, tag="trial.cancel"):
    """Throw the recording away."""


class TrialResume(_Client, tag="trial.resume"):
    """Go on with a recording after a reconnect."""

    trial: UUID


Recording = TrialStart | ClipStart | ClipStop | TrialStop | TrialCancel | TrialResume
Incoming = Auth | Frame | Configure | Reset | Ping | ClientPong | Recording


class Observation(Struct, frozen=True):
    """A decoded frame.

    Attributes:
        seq: the client's number of it.
        t: capture time on the client's clock, seconds.
        joints: metres, NaN for a missing joint; None for a frame without the person.
        confidence: 0 … 1 per joint, None if not given.
        replay: sent again after a reconnect, not to be answered.
    """

    seq: int
    t: float
    joints: Float[np.ndarray, "joint 3"] | None
    confidence: Float[np.ndarray, " number"] | None
    replay: bool


@dataclass(frozen=True, slots=True)
class Rejected:
    """A message that cannot be read, and the number of the frame if it was one."""

    error: KinecastError
    seq: int | None = None


Control = Auth | Configure | Reset | Ping | ClientPong | Recording
ClientMessage = Observation | Control | Rejected


class _Server(Struct, tag_field="type"):
    """Base of what the server sends."""


class StreamSettings(Struct, frozen=True):
    """How forecasts are made."""

    forecast_every: int
    coverage: float
    version: RequestedVersion
    max_age_ms: float


class Hello(_Server, tag="hello"):
    """The first message of every stream."""

    protocol: int
    features: tuple[str, ...]
    session: str
    epoch: int
    user: str
    skeleton: str
    joints: tuple[str, ...]
    rate_hz: float
    observe: int
    horizon: int
    version: VersionStamp
    settings: StreamSettings
    limits: Limits


class Forecast(_Server, tag="forecast"):
    """The next half second, from the frame `seq`."""

    seq: int
    t: float
    age_ms: float
    frames: np.ndarray
    t_out: np.ndarray
    radius: np.ndarray | None
    coverage: float
    version: VersionStamp
    quality: tuple[str, ...]
    severity: Severity
    filled: tuple[str, ...]
    skipped: int
    not_due: int
    timing: Timing


class VersionMessage(_Server, tag="version"):
    """Other weights are active: no forecast before it is theirs, every one after it is."""

    version: VersionStamp
    reason: str


class JobNote(Struct, frozen=True):
    """A job, as far as a stream is told of it at the end of a trial."""

    id: UUID
    state: str


class TrialMessage(_Server, tag="trial"):
    """How a recording stands: after every change, and once a second."""

    state: str
    trial: UUID
    clip: int | None
    stored_seq: int | None
    clips_dropped: int
    job: JobNote | UnsetType | None = UNSET


class JobMessage(_Server, tag="job"):
    """How a fine-tuning job of the user stands: when that changes."""

    id: UUID
    state: str
    progress: dict[str, Any] | None
    metrics: dict[str, Any] | UnsetType = UNSET


class WaitingMessage(_Server, tag="waiting"):
    """Why frames get no forecast: at the first of them, then once a second."""

    seq: int
    t: float
    reason: str
    have_s: float
    need_s: float


class Configured(_Server, tag="configured"):
    """The settings from the frame `from_seq` on."""

    settings: StreamSettings
    from_seq: int


class Pong(_Server, tag="pong"):
    """Answer to `Ping`."""

    id: int | str
    t: float
    server_t: float
    engine_ms: float


class ServerPing(_Server, tag="ping"):
    """Asks for a pong with the client's time."""

    id: int
    server_t: float


class ErrorMessage(_Server, tag="error"):
    """What was wrong, with which frame if with one."""

    code: str
    message: str
    retryable: bool
    seq: int | None


class Bye(_Server, tag="bye"):
    """The server is about to close the stream."""

    reason: str
    retry_after_s: float


ServerMessage = (
    Hello
    | Forecast
    | VersionMessage
    | TrialMessage
    | JobMessage
    | WaitingMessage
    | Configured
    | Pong
    | ServerPing
    | ErrorMessage
    | Bye
)

INCOMING: tuple[type[Struct], ...] = get_args(Incoming)
"""Every message that a client may send."""
