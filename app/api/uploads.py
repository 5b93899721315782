"""What an uploaded trial says, in whichever format, made into clips that can be stored.

`parse_upload` is pure and may take seconds for a large body, or meet a file that attacks its
parser: `app.api.upload_child` runs it in a process of its own.
"""

from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError

from app.api.bodies import (
    JSON_TYPE,
    MSGPACK_TYPE,
    Confidence,
    Poses,
    Times,
    check_shapes,
    decode_body,
    explain_body,
)
from app.api.multipart import Part, parse_form
from app.api.schemas import Name, RequestModel
from app.domain.errors import (
    BadRecordingError,
    FieldError,
    InvalidError,
    LimitExceededError,
    UnknownFieldError,
    UnsupportedMediaTypeError,
)
from app.personalize.files import read_file
from app.personalize.record import Sensor, examine_clip, make_frames
from app.storage.trials import NewClip

FORM_TYPE = "multipart/form-data"
FORMATS = (JSON_TYPE, MSGPACK_TYPE, FORM_TYPE)
_FLAGS = {"true": True, "false": False}
_NAME: TypeAdapter[str | None] = TypeAdapter(Name | None)


@dataclass(frozen=True, slots=True)
class UploadRules:
    """How an upload is read.

    Attributes:
        sensor: how the user's poses come.
        clips: most clips.
        frames_per_clip: most frames of each.
    """

    sensor: Sensor
    clips: int
    frames_per_clip: int


@dataclass(frozen=True, slots=True)
class Upload:
    """A trial that was read."""

    label: str | None
    finetune: bool
    clips: list[NewClip]


class ClipIn(RequestModel):
    """One clip: what happened without a break."""

    frames: Poses = Field(
        description="[time][joint][xyz] in metres, in the user's skeleton; null where missing."
    )
    t: Times | None = Field(
        None, description="Capture times in seconds, increasing; without them frames are 30 Hz."
    )
    confidence: Confidence | None = Field(None, description="[time][joint], from 0 to 1.")
    action: Name | None = Field(None, description="What the person did.")


class TrialIn(RequestModel):
    """A recorded trial."""

    model_config = ConfigDict(
        title="TrialRequest",
        json_schema_extra={
            "examples": [
                {
                    "label": "monday",
                    "clips": [
                        {"frames": [[[0.02, 0.71, 2.4], None]], "t": [0.0], "action": "wave"}
                    ],
                    "finetune": True,
                }
            ]
        },
    )

    label: Name | None = None
    clips: Annotated[list[ClipIn], Field(min_length=1)]
    finetune: bool = Field(default=True, strict=True, description="Whether to ask for a job.")


def parse_upload(content_type: str, body: bytes, rules: UploadRules) -> Upload:
    """Read an upload, check every frame, and look at every clip.

    Raises:
        UnsupportedMediaTypeError: another format than `FORMATS`.
        InvalidError: and its kinds, naming the clip.
    """
    media_type = content_type.partition(";")[0].strip().lower()
    if media_type == FORM_TYPE:
        return _parse_files(parse_form(content_type, body), rules)
    if media_type not in FORMATS:
        raise UnsupportedMediaTypeError(f"Send the body as one of {', '.join(FORMATS)}.")
    content = decode_body(body, as_msgpack=media_type == MSGPACK_TYPE)
    _check_lengths(content, rules)
    try:
        trial = TrialIn.model_validate(content)
    except ValidationError as error:
        raise explain_body(error, depth=3) from None
    clips = [_examine(clip, i, rules.sensor) for i, clip in enumerate(trial.clips)]
    return Upload(trial.label, trial.finetune, clips)


def _examine(clip: ClipIn, ordinal: int, sensor: Sensor) -> NewClip:
    try:
        check_shapes(clip.frames, clip.t, clip.confidence)
        frames = make_frames(clip.frames, clip.t, clip.confidence, sensor)
    except InvalidError as error:
        raise _place(error, f"Clip {ordinal}", ("body", "clips", ordinal)) from None
    return examine_clip(frames, sensor, ordinal=ordinal, action=clip.action)


def _parse_files(parts: list[Part], rules: UploadRules) -> Upload:
    files = [part for part in parts if part.filename is not None]
    fields = {part.name: part.content for part in parts if part.filename is None}
    unknown = sorted(fields.keys() - {"label", "finetune"})
    if unknown:
        raise UnknownFieldError(f"The form has a field {unknown[0]}; label and finetune are known.")
    if not files:
        raise InvalidError("The form has no file; send .mat, .npz or .csv.")
    clips: list[NewClip] = []
    for part in files:
        clips += _read_part(part, len(clips), rules)
    finetune = fields.get("finetune", b"true").decode("utf-8", errors="replace").lower()
    if finetune not in _FLAGS:
        raise InvalidError("finetune must be true or false.")
    label = fields.get("label", b"").decode("utf-8", errors="replace") or None
    _check_name(label, "label")
    return Upload(label, _FLAGS[finetune], clips)


def _check_name(name: str | None, where: str) -> None:
    """Hold what forms and files call things to the rule of JSON."""
    try:
        _NAME.validate_python(name)
    except ValidationError:
        raise InvalidError(f"{where} must be 1 to 200 characters, no control character.") from None


def _read_part(part: Part, first: int, rules: UploadRules) -> list[NewClip]:
    name = part.filename or ""
    found = read_file(name, part.content, skeleton=rules.sensor.skeleton)
    _check_count(first + len(found), rules.clips)
    clips = []
    for i, clip in enumerate(found):
        _check_frames(len(clip.joints), rules.frames_per_clip)
        try:
            _check_name(clip.action, "The action")
            frames = make_frames(clip.joints, clip.t, None, rules.sensor)
        except InvalidError as error:
            raise BadRecordingError(f"{name}, clip {i}: {error.message}") from None
        clips.append(examine_clip(frames, rules.sensor, ordinal=first + i, action=clip.action))
    return clips


def _check_lengths(content: object, rules: UploadRules) -> None:
    """Refuse too many clips or frames before looking at any of them."""
    clips = content.get("clips") if isinstance(content, dict) else None
    if not isinstance(clips, list):
        return
    _check_count(len(clips), rules.clips)
    for clip in clips:
        frames = clip.get("frames") if isinstance(clip, dict) else None
        if isinstance(frames, dict):
            shape = frames.get("shape")
            length = shape[0] if isinstance(shape, list) and shape else 0
        else:
            length = len(frames) if isinstance(frames, list) else 0
        _check_frames(length if isinstance(length, int) else 0, rules.frames_per_clip)


def _check_count(clips: int, limit: int) -> None:
    if clips > limit:
        raise LimitExceededError(f"At most {limit} clips are allowed.", limit="clips")


def _check_frames(frames: int, limit: int) -> None:
    if frames > limit:
        raise LimitExceededError(
            f"{frames} frames in a clip, at most {limit} are allowed.", limit="frames_per_clip"
        )


def _place(error: InvalidError, prefix: str, loc: tuple[Any, ...]) -> InvalidError:
    """Say in which clip it was."""
    error.message = f"{prefix}: {error.message}"
    error.errors = (FieldError(loc, error.message),)
    return error
