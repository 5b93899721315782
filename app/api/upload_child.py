"""The process in which uploads are read; see `app.api.uploads` for what it does with them."""

from typing import Any

import msgspec

from app.api.uploads import Upload, UploadRules, parse_upload
from app.domain import errors
from app.domain.errors import (
    BadRecordingError,
    FieldError,
    InvalidError,
    KinecastError,
    LimitExceededError,
)
from app.domain.trials import ClipFlaw, ClipInfo
from app.personalize.child import ChildError, run_child, serve_task
from app.storage.trials import NewClip


class Task(msgspec.Struct):
    """What the child is to read."""

    content_type: str
    body: bytes
    rules: UploadRules


class Failure(msgspec.Struct):
    """What was wrong with an upload, as it crosses the process border."""

    code: str
    message: str
    errors: list[tuple[list[str | int], str]]
    limit: str | None


class ReadClip(msgspec.Struct):
    """One clip that was read."""

    action: str | None
    frames: int
    seconds: float
    flaw: ClipFlaw | None
    payload: bytes


class Reading(msgspec.Struct):
    """What the child answers: one of both."""

    label: str | None = None
    finetune: bool = True
    clips: list[ReadClip] = []
    failure: Failure | None = None


async def read_upload(
    content_type: str, body: bytes, rules: UploadRules, *, timeout_s: float, memory_bytes: int
) -> Upload:
    """Read an upload in a process of its own.

    Raises:
        BadRecordingError: it took too long or too much memory, or ended its reader.
        KinecastError: what `parse_upload` found wrong.
    """
    task = msgspec.msgpack.encode(Task(content_type, body, rules))
    try:
        answer = await run_child(__name__, task, timeout_s=timeout_s, memory_bytes=memory_bytes)
    except ChildError as error:
        raise BadRecordingError(f"Reading the upload failed: {error}.") from error
    reading = msgspec.msgpack.decode(answer, type=Reading)
    if reading.failure is not None:
        raise _rebuild(reading.failure)
    clips = [_to_clip(clip, i) for i, clip in enumerate(reading.clips)]
    return Upload(reading.label, reading.finetune, clips)


def work(task: bytes) -> bytes:
    """Do the child's part."""
    wanted = msgspec.msgpack.decode(task, type=Task)
    try:
        upload = parse_upload(wanted.content_type, wanted.body, wanted.rules)
    except KinecastError as error:
        return msgspec.msgpack.encode(Reading(failure=_describe(error)))
    clips = [
        ReadClip(
            action=clip.info.action,
            frames=clip.info.frames,
            seconds=clip.info.seconds,
            flaw=clip.info.flaw,
            payload=clip.payload,
        )
        for clip in upload.clips
    ]
    return msgspec.msgpack.encode(Reading(upload.label, upload.finetune, clips))


def _to_clip(clip: ReadClip, ordinal: int) -> NewClip:
    info = ClipInfo(
        ordinal=ordinal,
        action=clip.action,
        frames=clip.frames,
        seconds=clip.seconds,
        flaw=clip.flaw,
    )
    return NewClip(info, clip.payload)


def _describe(error: KinecastError) -> Failure:
    places = error.errors if isinstance(error, InvalidError) else ()
    return Failure(
        code=error.code,
        message=error.message,
        errors=[(list(place.loc), place.msg) for place in places],
        limit=error.limit if isinstance(error, LimitExceededError) else None,
    )


def _rebuild(failure: Failure) -> KinecastError:
    """Raise in the parent what was raised in the child."""
    kinds: dict[str, type[Any]] = {
        kind.code: kind
        for kind in vars(errors).values()
        if isinstance(kind, type) and issubclass(kind, KinecastError)
    }
    kind = kinds[failure.code]
    places = tuple(FieldError(tuple(loc), msg) for loc, msg in failure.errors)
    error: KinecastError
    if issubclass(kind, LimitExceededError):
        error = kind(failure.message, limit=failure.limit or "", errors=places)
    elif issubclass(kind, InvalidError):
        error = kind(failure.message, errors=places)
    else:
        error = kind(failure.message)
    return error


if __name__ == "__main__":
    serve_task(work)
