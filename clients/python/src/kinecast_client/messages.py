"""What client and service say on a stream: structs, and their bytes in both subprotocols.

Unknown fields are ignored and unknown messages kept as `Other`: the service may learn to say more.
"""

import math
import sys
from typing import Any, Literal, cast

import msgspec
import numpy as np
import numpy.typing as npt
from msgspec import Raw, Struct

from kinecast_client.forecasts import Timing, Version

PROTOCOL = 1
JSON = "kinecast.v1.json"
MSGPACK = "kinecast.v1.msgpack"
SUBPROTOCOLS = {"json": JSON, "msgpack": MSGPACK}
Form = Literal["json", "msgpack"]

_MICROMETRES = 6
_BIG_ENDIAN = sys.byteorder == "big"

Floats = npt.NDArray[np.float64]


class Settings(Struct, frozen=True):
    """How forecasts are made.

    Attributes:
        forecast_every: answer every n-th frame, 1 to 600.
        coverage: probability for `radius`, above 0 and below 1.
        version: `active`, `base` or a number.
        max_age_ms: a frame that is older when its forecast would leave gets none.
    """

    forecast_every: int = 1
    coverage: float = 0.9
    version: str | int = "active"
    max_age_ms: float = 200.0


class _Said(Struct, tag_field="type", frozen=True):
    """Base of what the service says."""


class Hello(_Said, tag="hello", frozen=True):
    """The first message: what the service takes us for."""

    protocol: int
    session: str
    epoch: int
    user: str
    skeleton: str
    joints: tuple[str, ...]
    rate_hz: float
    observe: int
    horizon: int
    version: Version
    settings: Settings
    limits: dict[str, Any]
    features: tuple[str, ...] = ()


class Waiting(_Said, tag="waiting", frozen=True):
    """Why frames get no forecast at the moment."""

    seq: int
    t: float
    reason: str
    have_s: float
    need_s: float


class Configured(_Said, tag="configured", frozen=True):
    """The settings from the frame `from_seq` on."""

    settings: Settings
    from_seq: int


class Pong(_Said, tag="pong", frozen=True):
    """Answer to a ping of ours: our `t`, the service's time, and how fast forecasts are now."""

    id: int | str
    t: float
    server_t: float
    engine_ms: float


class Ping(_Said, tag="ping", frozen=True):
    """The service asks for our time; the client answers by itself."""

    id: int
    server_t: float


class ServiceError(_Said, tag="error", frozen=True):
    """What was wrong, with which frame if with one."""

    code: str
    message: str
    retryable: bool = False
    seq: int | None = None


class VersionChanged(_Said, tag="version", frozen=True):
    """Other weights answer from now on."""

    version: Version
    reason: str = ""


class JobNote(Struct, frozen=True):
    """The job that a recording asked for."""

    id: str
    state: str


class TrialNews(_Said, tag="trial", frozen=True):
    """How a recording stands; `job` comes with its end."""

    state: str
    trial: str
    clip: int | None = None
    stored_seq: int | None = None
    clips_dropped: int = 0
    job: JobNote | None = None


class JobNews(_Said, tag="job", frozen=True):
    """How a fine-tuning job of the user stands."""

    id: str
    state: str
    progress: dict[str, Any] | None = None
    metrics: dict[str, Any] | None = None


class Bye(_Said, tag="bye", frozen=True):
    """The service is about to close the stream."""

    reason: str
    retry_after_s: float = 0.0


class WireForecast(_Said, tag="forecast", frozen=True):
    """A forecast whose arrays are still in the wire's form."""

    seq: int
    t: float
    age_ms: float
    frames: Raw
    t_out: Raw
    radius: Raw
    coverage: float
    version: Version
    quality: tuple[str, ...]
    severity: str
    filled: tuple[str, ...]
    skipped: int
    not_due: int
    timing: Timing


class Other(Struct, frozen=True):
    """A message that this client does not know."""

    type: str


Message = (
    Hello
    | WireForecast
    | VersionChanged
    | TrialNews
    | JobNews
    | Waiting
    | Configured
    | Pong
    | Ping
    | ServiceError
    | Bye
)


class Wire:
    """One subprotocol: messages to bytes and back."""

    def __init__(self, form: Form) -> None:
        self.subprotocol = SUBPROTOCOLS[form]
        self.is_binary = form == "msgpack"
        library: Any = msgspec.msgpack if self.is_binary else msgspec.json
        self._encoder, self._any = library.Encoder(), library.Decoder()
        self._known, self._other = library.Decoder(Message), library.Decoder(Other)

    def encode(self, kind: str, **fields: object) -> str | bytes:
        """Write a message: text in JSON, bytes in msgpack."""
        data: bytes = self._encoder.encode({"type": kind, **fields})
        return data if self.is_binary else data.decode()

    def encode_frame(
        self,
        seq: int,
        t: float,
        joints: npt.NDArray[np.float32] | None,
        confidence: npt.NDArray[np.float32] | None,
        *,
        replay: bool,
    ) -> str | bytes:
        """Write a frame; joints [J, 3] with NaN where missing, None without the person."""
        fields: dict[str, object] = {"joints": None if joints is None else self._pose(joints)}
        if confidence is not None:
            fields["confidence"] = (
                _to_bytes(confidence)
                if self.is_binary
                else confidence.astype(np.float64).round(_MICROMETRES).tolist()
            )
        if replay:
            fields["replay"] = True
        return self.encode("frame", seq=seq, t=t, **fields)

    def decode(self, data: str | bytes) -> Message | Other:
        """Read a message of the service; the arrays of a forecast stay as they are.

        Raises:
            ValueError: it is broken, or in the other subprotocol's kind of frame.
        """
        if isinstance(data, str) == self.is_binary:
            raise ValueError("text and binary messages are mixed up")
        raw = data.encode() if isinstance(data, str) else data
        try:
            try:
                return cast("Message", self._known.decode(raw))
            except msgspec.ValidationError:
                other = cast("Other", self._other.decode(raw))
                if other.type in _KNOWN_TYPES:
                    raise
                return other
        except (msgspec.DecodeError, UnicodeError, RecursionError) as error:
            raise ValueError(f"a broken message: {error}") from None

    def read_array(self, raw: Raw, dtype: Literal["<f4", "<f8"]) -> npt.NDArray[Any] | None:
        """Read an array of a forecast, flat; None where there is none.

        Raises:
            ValueError: it is no array of numbers.
        """
        try:
            value = self._any.decode(raw)
            if value is None:
                return None
            if isinstance(value, bytes) and self.is_binary:
                return np.frombuffer(value, dtype)
            return np.asarray(value, dtype).reshape(-1)
        except (msgspec.DecodeError, UnicodeError, TypeError, OverflowError, RecursionError) as bad:
            raise ValueError(f"a broken array: {bad}") from None

    def _pose(self, joints: npt.NDArray[np.float32]) -> object:
        if self.is_binary:
            return _to_bytes(joints)
        rows = joints.astype(np.float64).round(_MICROMETRES).tolist()
        return [None if any(map(math.isnan, row)) else row for row in rows]


def _to_bytes(array: npt.NDArray[np.float32]) -> bytes:
    return (array.byteswap() if _BIG_ENDIAN else array).tobytes()


_KNOWN_TYPES = frozenset(
    str(kind.__struct_config__.tag)
    for kind in (
        Hello,
        WireForecast,
        VersionChanged,
        TrialNews,
        JobNews,
        Waiting,
        Configured,
        Pong,
        Ping,
        ServiceError,
        Bye,
    )
)
