"""The limits that clients are told, the same over REST and on a stream."""

from dataclasses import dataclass

from app.settings import Settings


@dataclass(frozen=True, slots=True)
class Limits:
    """What a client may send at most; ``GET /v1/limits`` and ``hello.limits``.

    Attributes:
        max_message_bytes: largest message of a stream.
        max_rate_hz: highest frame rate of a stream.
        idle_s: seconds without a message after which a stream is closed.
        streams_per_key: open streams per key and replica.
        streams_per_user: open streams per user and replica.
        forecast_frames: most frames in one forecast request.
        trial_bytes: largest body of an uploaded trial.
        clips: most clips of a trial.
        frames_per_clip: most frames of a clip.
    """

    max_message_bytes: int
    max_rate_hz: float
    idle_s: float
    streams_per_key: int
    streams_per_user: int
    forecast_frames: int
    trial_bytes: int
    clips: int
    frames_per_clip: int


def read_limits(settings: Settings) -> Limits:
    """Take the published limits out of the settings."""
    return Limits(
        max_message_bytes=settings.max_message_bytes,
        max_rate_hz=settings.max_rate_hz,
        idle_s=settings.idle_s,
        streams_per_key=settings.streams_per_key,
        streams_per_user=settings.streams_per_user,
        forecast_frames=settings.forecast_frames,
        trial_bytes=settings.trial_bytes,
        clips=settings.clips,
        frames_per_clip=settings.frames_per_clip,
    )


FEATURES: tuple[str, ...] = ("forecast", "stream", "msgpack", "trials", "finetune", "recording")
"""What this server can do; the list grows, and clients ignore what they do not know."""
