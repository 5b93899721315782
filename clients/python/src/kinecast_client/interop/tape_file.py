"""Streams as MCAP files: every frame and forecast without loss, and pictures for Foxglove.

Needs the package `mcap` (`pip install 'kinecast-client[mcap]'`). Channels:

| topic | schema | what |
|---|---|---|
| `/kinecast/frames` | `kinecast.Frame` | what was sent |
| `/kinecast/forecasts` | `kinecast.Forecast` | what came back |
| `/observed`, `/forecast` | `foxglove.SceneUpdate` | for the 3D panel |
| `/tf` | `foxglove.FrameTransforms` | `world`, the sensor, the body |

All messages are JSON, which Foxglove reads by itself: a plot of a hand half a second ahead is
`/kinecast/forecasts.frames[14].joints[11].x`. Every number is written so that it is read as the
same float64; coordinates that are missing (NaN) are null. The metadata `kinecast` says whose stream
was recorded.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
from mcap.reader import make_reader
from mcap.writer import Writer

from kinecast_client.forecasts import Forecast, Timing, Version
from kinecast_client.interop import foxglove
from kinecast_client.interop.body import Skeleton
from kinecast_client.interop.ros import name_body

FRAMES, FORECASTS = "/kinecast/frames", "/kinecast/forecasts"
_METADATA = "kinecast"
_POINTS = foxglove.describe_list(foxglove.POINT)
_NUMBERS = foxglove.describe_list(foxglove.NUMBER)
_NAMES = foxglove.describe_list(foxglove.TEXT)
FRAME_SCHEMA = foxglove.describe_object(
    "kinecast.Frame",
    seq=foxglove.WHOLE,
    t=foxglove.NUMBER,
    person=foxglove.SWITCH,
    joints=_POINTS,
    confidence=_NUMBERS,
)
"""JSON Schema of a frame; `person` is false, and `joints` empty, where nobody was seen."""
FORECAST_SCHEMA = foxglove.describe_object(
    "kinecast.Forecast",
    seq=foxglove.WHOLE,
    t_observed=foxglove.NUMBER,
    frames=foxglove.describe_list(
        foxglove.describe_object("frame", t=foxglove.NUMBER, joints=_POINTS, radius=_NUMBERS)
    ),
    coverage=foxglove.NUMBER,
    version=foxglove.describe_object(
        "version",
        number=foxglove.WHOLE,
        kind=foxglove.TEXT,
        sha256=foxglove.TEXT,
        requested=foxglove.TEXT,
        share=foxglove.NUMBER,
        fallback=foxglove.TEXT,
    ),
    quality=_NAMES,
    severity=foxglove.TEXT,
    filled=_NAMES,
    timing=foxglove.describe_object(
        "timing", **dict.fromkeys(("queue_ms", "compute_ms", "total_ms"), foxglove.NUMBER)
    ),
    joints=_NAMES,
    skipped=foxglove.WHOLE,
    not_due=foxglove.WHOLE,
    server_age_ms=foxglove.NUMBER,
)
"""JSON Schema of a forecast; `radius` is empty where there is none. What is unknown is null."""
_SAME = (
    *("seq", "t_observed", "coverage", "version", "quality", "severity", "filled", "timing"),
    *("joints", "skipped", "not_due", "server_age_ms"),
)
"""Fields of a forecast that are written as they are."""


CHANNELS = {
    FRAMES: FRAME_SCHEMA,
    FORECASTS: FORECAST_SCHEMA,
    "/observed": foxglove.SCENE_UPDATE,
    "/forecast": foxglove.SCENE_UPDATE,
    "/tf": foxglove.FRAME_TRANSFORMS,
}


class TapeError(ValueError):
    """A file is no recording of a stream."""


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame as it was sent.

    Attributes:
        t: capture time, seconds on the clock of the stream.
        joints: [joint, 3] metres, NaN where missing; None for a frame without the person.
        confidence: [joint], None where there was none.
        seq: its number on the stream; None where it was not sent.
    """

    t: float
    joints: npt.NDArray[np.floating[Any]] | None
    confidence: npt.NDArray[np.floating[Any]] | None = None
    seq: int | None = None


@dataclass(frozen=True)
class About:
    """Whose stream it is, and how to draw it.

    Attributes:
        user: whose motion.
        skeleton: the user's.
        up: the user's.
        frame_id: of the sensor.
    """

    user: str
    skeleton: Skeleton
    up: str = "y"
    frame_id: str = "sensor"


@dataclass
class TapeWriter:
    """Writes a stream to a file. Use it in `with`, or `close` it: only then is the file whole.

    Attributes:
        path: the file; what it held is lost.
        about: whose stream it is.
        clock: gives the time of the frames in seconds, where that is not `time.monotonic`.
    """

    path: Path
    about: About
    clock: Callable[[], float] = time.monotonic
    _channels: dict[str, int] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        """Open the file and describe what will be in it."""
        self._epoch_ns = time.time_ns() - round(self.clock() * 1e9)
        self._file = self.path.open("wb")
        self._writer = Writer(self._file)
        self._writer.start(profile="", library="kinecast-client")
        self._writer.add_metadata(_METADATA, _describe(self.about))
        for topic, schema in CHANNELS.items():
            self._add_channel(topic, schema)

    def __enter__(self) -> "TapeWriter":
        """Begin to write."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the file, also after an error: what was written until then can be read."""
        self.close()

    def close(self) -> None:
        """Write the index and close the file."""
        if not self._file.closed:
            self._writer.finish()
            self._file.close()

    def write_frame(self, frame: Frame) -> None:
        """Write a frame, and its picture."""
        at = self._to_ns(frame.t)
        message = {
            "seq": frame.seq,
            "t": frame.t,
            "person": frame.joints is not None,
            "joints": [] if frame.joints is None else _to_points(frame.joints),
            "confidence": _to_numbers(frame.confidence),
        }
        self._add(FRAMES, at, message)
        if frame.joints is None:
            return
        drawn, pose = self._drawing, np.asarray(frame.joints, dtype=np.float64)
        self._add("/observed", at, foxglove.make_observed_scene(pose, at, **drawn))
        body = name_body(self.about.user)
        moved = foxglove.make_frame_transforms(pose, at, body=body, **drawn)
        self._add("/tf", at, moved)

    def write_forecast(self, forecast: Forecast) -> None:
        """Write a forecast, and its picture; both at the time of its newest frame."""
        at = self._to_ns(forecast.t_observed)
        self._add(FORECASTS, at, _to_message(forecast))
        picture = foxglove.make_forecast_scene(forecast, at, **self._drawing)
        self._add("/forecast", at, picture)

    @property
    def _drawing(self) -> dict[str, Any]:
        about = self.about
        return {"skeleton": about.skeleton, "up": about.up, "frame_id": about.frame_id}

    def _add_channel(self, topic: str, schema: dict[str, Any]) -> None:
        data = msgspec.json.encode(schema)
        number = self._writer.register_schema(schema["title"], "jsonschema", data)
        self._channels[topic] = self._writer.register_channel(topic, "json", number)

    def _add(self, topic: str, at_ns: int, message: dict[str, Any]) -> None:
        self._writer.add_message(
            self._channels[topic],
            log_time=at_ns,
            publish_time=at_ns,
            data=msgspec.json.encode(message),
        )

    def _to_ns(self, t: float) -> int:
        return max(0, self._epoch_ns + round(t * 1e9))


class TapeReader:
    """Reads what a `TapeWriter` wrote.

    Attributes:
        about: whose stream it is.

    Raises:
        TapeError: the file is no recording of a stream.
        OSError: it cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with path.open("rb") as file:
            try:
                found = {one.name: one.metadata for one in make_reader(file).iter_metadata()}
                self.about = _restore(found[_METADATA])
            except Exception as error:
                raise TapeError(f"{path} is no recording of a Kinecast stream") from error

    def frames(self) -> Iterator[Frame]:
        """Give the frames in the order of their times."""
        for data in self._read(FRAMES):
            found = msgspec.json.decode(data)
            joints = _from_points(found["joints"]) if found["person"] else None
            yield Frame(found["t"], joints, _from_numbers(found["confidence"]), found["seq"])

    def forecasts(self) -> Iterator[Forecast]:
        """Give the forecasts in the order of their times; their `age_s` is 0."""
        for data in self._read(FORECASTS):
            yield _to_forecast(msgspec.json.decode(data))

    def _read(self, topic: str) -> Iterator[bytes]:
        with self.path.open("rb") as file:
            for _, _, message in make_reader(file).iter_messages(topics=[topic]):
                yield message.data


def _describe(about: About) -> dict[str, str]:
    return {
        "user": about.user,
        "up": about.up,
        "frame_id": about.frame_id,
        "joints": msgspec.json.encode(about.skeleton.joints).decode(),
        "bones": msgspec.json.encode(about.skeleton.bones).decode(),
    }


def _restore(found: dict[str, str]) -> About:
    joints = msgspec.json.decode(found["joints"], type=tuple[str, ...])
    bones = msgspec.json.decode(found["bones"], type=tuple[tuple[int, int], ...])
    return About(found["user"], Skeleton(joints, bones), found["up"], found["frame_id"])


def _to_message(forecast: Forecast) -> dict[str, Any]:
    radii = [None] * len(forecast.t) if forecast.radius is None else list(forecast.radius)
    steps = zip(forecast.t.tolist(), forecast.frames, radii, strict=True)
    frames = [
        {"t": t, "joints": _to_points(pose), "radius": _to_numbers(radius)}
        for t, pose, radius in steps
    ]
    return {name: getattr(forecast, name) for name in _SAME} | {"frames": frames}


def _to_forecast(found: dict[str, Any]) -> Forecast:
    frames = found["frames"]
    radii = [_from_numbers(frame["radius"]) for frame in frames]
    return Forecast(
        **{name: found[name] for name in _SAME}
        | {name: tuple(found[name]) for name in ("quality", "filled", "joints")}
        | {
            "frames": np.array([_from_points(frame["joints"]) for frame in frames], np.float32),
            "t": np.array([frame["t"] for frame in frames], dtype=np.float64),
            "radius": None if radii[0] is None else np.array(radii, dtype=np.float32),
            "version": msgspec.convert(found["version"], Version),
            "timing": msgspec.convert(found["timing"], Timing),
        }
    )


def _to_points(pose: npt.NDArray[np.floating[Any]]) -> list[dict[str, float]]:
    """Give a pose as JSON; a float32 becomes the float64 of the same value, which is exact."""
    return [{"x": x, "y": y, "z": z} for x, y, z in pose.astype(np.float64).tolist()]


def _from_points(points: list[dict[str, float | None]]) -> npt.NDArray[np.float64]:
    return np.array([(point["x"], point["y"], point["z"]) for point in points], dtype=np.float64)


def _to_numbers(values: npt.NDArray[np.floating[Any]] | None) -> list[float]:
    numbers: list[float] = [] if values is None else values.astype(np.float64).tolist()
    return numbers


def _from_numbers(values: list[float]) -> npt.NDArray[np.float64] | None:
    return np.array(values, dtype=np.float64) if values else None
