"""What client and server say on a stream, in both subprotocols.

Unknown fields are ignored and unknown messages kept as `Other`: the server may learn to say more.
"""

from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Float, Float32, Float64
from msgspec import Raw, Struct

JSON = "kinecast.v1.json"
MSGPACK = "kinecast.v1.msgpack"
SUBPROTOCOLS = {"json": JSON, "msgpack": MSGPACK}

_MICROMETRES = 6


class Version(Struct, frozen=True):
    """Which weights a forecast came from."""

    number: int | None
    kind: str
    sha256: str | None
    requested: str | int = "active"
    share: float = 0.0
    fallback: str | None = None


class Timing(Struct, frozen=True):
    """Where the server's time went, in milliseconds."""

    queue_ms: float
    compute_ms: float
    total_ms: float


class _Said(Struct, tag_field="type"):
    """Base of what the server says."""


class Hello(_Said, tag="hello"):
    """The first message."""

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
    settings: dict[str, Any]
    limits: dict[str, Any]
    features: tuple[str, ...] = ()


class Waiting(_Said, tag="waiting"):
    """Why frames get no forecast at the moment."""

    seq: int
    t: float
    reason: str
    have_s: float
    need_s: float


class Configured(_Said, tag="configured"):
    """The settings from the frame `from_seq` on."""

    settings: dict[str, Any]
    from_seq: int


class Pong(_Said, tag="pong"):
    """Answer to a ping of ours: our `t`, the server's time, and how fast forecasts are now."""

    id: int | str
    t: float
    server_t: float
    engine_ms: float


class Ping(_Said, tag="ping"):
    """The server asks for our time; the client answers by itself."""

    id: int
    server_t: float


class Error(_Said, tag="error"):
    """What was wrong, with which frame if with one."""

    code: str
    message: str
    retryable: bool = False
    seq: int | None = None


class VersionChanged(_Said, tag="version"):
    """Other weights answer from now on."""

    version: Version
    reason: str = ""


class Trial(_Said, tag="trial"):
    """How a recording stands; `job` comes with its end."""

    state: str
    trial: str
    clip: int | None = None
    stored_seq: int | None = None
    clips_dropped: int = 0
    job: dict[str, Any] | None = None


class Job(_Said, tag="job"):
    """How a fine-tuning job stands."""

    id: str
    state: str
    progress: dict[str, Any] | None = None
    metrics: dict[str, Any] | None = None


class Bye(_Said, tag="bye"):
    """The server is about to close the stream."""

    reason: str
    retry_after_s: float = 0.0


class _WireForecast(_Said, tag="forecast"):
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


@dataclass(frozen=True, slots=True, eq=False)
class Forecast:
    """The next half second, from the frame `seq`.

    Attributes:
        seq: number of the newest frame that was used.
        t: its time on the client's clock, seconds.
        age_ms: how old the server took it to be.
        frames: metres, in the user's skeleton and frame of reference.
        t_out: times of the frames on the client's clock, seconds.
        radius: metres, None where it is not calibrated.
        coverage: probability that the true joint lies within `radius`.
        version: the weights that answered.
        quality: flags.
        severity: that of the worst flag.
        filled: joints that were carried.
        skipped: frames since the forecast before that a newer one superseded.
        not_due: frames since then for which no forecast was asked.
        timing: where the server's time went.
    """

    seq: int
    t: float
    age_ms: float
    frames: Float32[np.ndarray, "horizon joint 3"]
    t_out: Float64[np.ndarray, " horizon"]
    radius: Float32[np.ndarray, "horizon joint"] | None
    coverage: float
    version: Version
    quality: tuple[str, ...]
    severity: str
    filled: tuple[str, ...]
    skipped: int
    not_due: int
    timing: Timing


@dataclass(frozen=True, slots=True)
class Other:
    """A message that this client does not know."""

    type: str
    fields: dict[str, Any]


_Plain = Hello | VersionChanged | Trial | Job | Waiting | Configured | Pong | Ping | Error | Bye
Message = _Plain | Forecast | Other
_Known = _Plain | _WireForecast


class Wire:
    """One subprotocol: messages to bytes and back."""

    def __init__(self, subprotocol: str) -> None:
        self.is_binary = subprotocol == MSGPACK
        form: Any = msgspec.msgpack if self.is_binary else msgspec.json
        self._encoder, self._any = form.Encoder(), form.Decoder()
        self._known = form.Decoder(_Known)

    def encode(self, kind: str, **fields: object) -> str | bytes:
        """Write a message: text in JSON, bytes in msgpack."""
        data: bytes = self._encoder.encode({"type": kind, **fields})
        return data if self.is_binary else data.decode()

    def encode_frame(
        self,
        seq: int,
        t: float,
        joints: Float[np.ndarray, "joint 3"] | None,
        confidence: Float[np.ndarray, " joint"] | None = None,
        **fields: object,
    ) -> str | bytes:
        """Write a frame; a joint with NaN in it is missing, None is a frame without the person."""
        if joints is not None:
            fields["joints"] = self._write_joints(joints)
        else:
            fields["joints"] = None
        if confidence is not None:
            fields["confidence"] = (
                confidence.astype("<f4").tobytes() if self.is_binary else confidence.tolist()
            )
        return self.encode("frame", seq=seq, t=t, **fields)

    def decode(self, data: str | bytes) -> Message:
        """Read a message of the server.

        Raises:
            ValueError: it is broken, or arrays do not fit.
        """
        raw = data.encode() if isinstance(data, str) else data
        try:
            said: _Known = self._known.decode(raw)
        except msgspec.ValidationError:
            fields = self._any.decode(raw)
            kind = fields.get("type") if isinstance(fields, dict) else None
            if not isinstance(kind, str):
                raise
            return Other(kind, fields)
        return self._read_forecast(said) if isinstance(said, _WireForecast) else said

    def _write_joints(self, joints: Float[np.ndarray, "joint 3"]) -> object:
        if self.is_binary:
            return joints.astype("<f4").tobytes()
        rows = joints.astype(np.float64).round(_MICROMETRES)
        return [None if np.isnan(row).any() else row.tolist() for row in rows]

    def _read_forecast(self, said: _WireForecast) -> Forecast:
        t_out = self._read_array(said.t_out, "<f8")
        if t_out is None:
            raise ValueError("a forecast without times")
        frames = self._read_array(said.frames, "<f4")
        radius = self._read_array(said.radius, "<f4")
        horizon = len(t_out)
        if frames is None or frames.size % (3 * horizon):
            raise ValueError("a forecast whose frames do not fit its times")
        rest = {name: getattr(said, name) for name in _PLAIN}
        return Forecast(
            frames=frames.reshape(horizon, -1, 3),
            t_out=t_out,
            radius=None if radius is None else radius.reshape(horizon, -1),
            **rest,
        )

    def _read_array(self, raw: Raw, dtype: str) -> Any:  # noqa: ANN401 - float32 or float64
        value = self._any.decode(raw)
        if value is None:
            return None
        if isinstance(value, bytes):
            return np.frombuffer(value, dtype)
        return np.asarray(value, dtype).reshape(-1)


_ARRAYS = {"frames", "t_out", "radius"}
_PLAIN = tuple(name for name in _WireForecast.__struct_fields__ if name not in _ARRAYS)
