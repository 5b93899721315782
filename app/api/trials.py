"""`/v1/users/{user}/trials`: what people were recorded doing."""

import hashlib
from typing import Annotated
from uuid import UUID

import msgspec
from fastapi import APIRouter, Depends, Header, Request, Response
from starlette.concurrency import run_in_threadpool

from app.api.bodies import BINARY, JSON_TYPE, MSGPACK_TYPE, wants_msgpack
from app.api.dependencies import (
    PAGE_SIZE,
    After,
    DatabaseNeeded,
    PageSize,
    PathUser,
    Recorder,
    SettingsNeeded,
)
from app.api.openapi import DENIED, needs, problems
from app.api.schemas import ClipOut, JobOut, PageOut, RecordedOut, TrialOut
from app.api.upload_child import read_upload
from app.api.uploads import FORM_TYPE, FORMATS, TrialIn, Upload, UploadRules, parse_upload
from app.domain import errors
from app.domain.access import Principal, Scope
from app.domain.errors import InvalidError, UnsupportedMediaTypeError
from app.domain.trials import ClipInfo, Trial
from app.domain.users import User
from app.personalize.record import Recorded, Sensor, store_upload
from app.settings import Settings
from app.storage import idempotency, trials
from app.storage.database import Database
from app.storage.tables import utc_now

router = APIRouter(tags=["trials"])
RECORD = needs(Scope.RECORD)
ROUTE = "POST trials"
INLINE_BYTES = 131_072
"""Bodies up to this are read at once; larger ones, and files, in a process of their own."""

IdempotencyKey = Annotated[
    str | None,
    Header(
        alias="Idempotency-Key",
        min_length=1,
        max_length=200,
        description="The same key and body within a day get the same answer, and store nothing.",
    ),
]


async def _read_body(request: Request, caller: Recorder) -> bytes:
    """Read the body after the caller is known."""
    del caller
    media_type = _media_type(request)
    if media_type not in FORMATS:
        raise UnsupportedMediaTypeError(f"Send the body as one of {', '.join(FORMATS)}.")
    return await request.body()


@router.post(
    "/v1/users/{user}/trials",
    status_code=202,
    summary="Upload a trial",
    response_model=RecordedOut,
    openapi_extra={
        **RECORD,
        "requestBody": {
            "required": True,
            "content": {
                JSON_TYPE: {"schema": TrialIn.model_json_schema()},
                MSGPACK_TYPE: {"schema": BINARY},
                FORM_TYPE: {
                    "schema": {
                        "type": "object",
                        "properties": {
                            "file": {
                                "type": "array",
                                "items": {"type": "string", "format": "binary"},
                                "description": ".mat of UTD-MHAD, .npz without pickles, or .csv",
                            },
                            "label": {"type": "string"},
                            "finetune": {"type": "string", "enum": ["true", "false"]},
                        },
                    }
                },
            },
        },
    },
    responses={
        202: {"content": {MSGPACK_TYPE: {"schema": BINARY}}},
        **problems(
            *DENIED,
            errors.UnknownUserError,
            errors.TooLargeError,
            UnsupportedMediaTypeError,
            errors.BadMessageError,
            InvalidError,
            errors.BadFrameError,
            errors.BadRecordingError,
            errors.KeyReusedError,
            errors.LimitExceededError,
        ),
    },
)
async def add_trial(
    caller: Recorder,
    user: PathUser,
    body: Annotated[bytes, Depends(_read_body)],
    settings: SettingsNeeded,
    database: DatabaseNeeded,
    request: Request,
    token: IdempotencyKey = None,
) -> Response:
    """Store a trial as it was received, and ask for fine-tuning on it.

    Clips that are too short or show no believable person are stored, marked unused and reported.
    """
    wanted = _identify(caller, user, body, token)
    if wanted is not None:
        async with database.write() as tx:
            known = await idempotency.find(tx, wanted, now=utc_now())
        if known is not None:
            return _respond(request, known)
    upload = await _parse(request.headers.get("content-type", ""), body, user, settings)
    return _respond(request, await _store(database, user, upload, caller, wanted))


@router.get(
    "/v1/users/{user}/trials",
    summary="List trials",
    openapi_extra=RECORD,
    responses=problems(*DENIED, errors.UnknownUserError, InvalidError),
)
async def list_trials(
    caller: Recorder,
    user: PathUser,
    database: DatabaseNeeded,
    after: After,
    limit: PageSize = PAGE_SIZE,
) -> PageOut[TrialOut]:
    """List the trials of a user, newest first, the cancelled ones too."""
    del caller
    async with database.read() as tx:
        page = await trials.list_page(tx, user, after=after, limit=limit)
    items = [show_trial(trial) for trial in page.items]
    return PageOut[TrialOut](items=items, next_cursor=page.next_cursor)


@router.get(
    "/v1/users/{user}/trials/{trial}",
    summary="Get a trial",
    openapi_extra=RECORD,
    responses=problems(*DENIED, errors.UnknownTrialError, InvalidError),
)
async def get_trial(
    caller: Recorder, user: PathUser, trial: UUID, database: DatabaseNeeded
) -> TrialOut:
    """Get one trial, with what is known of each clip."""
    del caller
    async with database.read() as tx:
        return show_trial(await trials.get(tx, user, trial))


@router.delete(
    "/v1/users/{user}/trials/{trial}",
    status_code=204,
    summary="Erase a trial",
    openapi_extra=RECORD,
    responses=problems(*DENIED, errors.UnknownTrialError, errors.TrialConflictError, InvalidError),
)
async def erase_trial(
    caller: Recorder, user: PathUser, trial: UUID, database: DatabaseNeeded
) -> None:
    """Erase a trial with every frame of it; versions that learned from it stay."""
    async with database.write() as tx:
        await trials.erase(tx, user, trial, actor=caller.key_id)
    await database.forget_erased()


def show_trial(trial: Trial) -> TrialOut:
    """Show a trial."""
    return TrialOut(
        id=trial.id,
        user=trial.user,
        label=trial.label,
        state=trial.state,
        source=trial.source,
        finetune=trial.finetune,
        clips=len(trial.clips),
        clips_unused=sum(not clip.used for clip in trial.clips),
        frames=trial.frames,
        seconds=round(trial.seconds, 3),
        created_at=trial.created_at,
        stored_at=trial.stored_at,
        details=[_show_clip(clip) for clip in trial.clips],
    )


def _show_clip(clip: ClipInfo) -> ClipOut:
    return ClipOut(
        ordinal=clip.ordinal,
        action=clip.action,
        frames=clip.frames,
        seconds=round(clip.seconds, 3),
        used=clip.used,
        reason=clip.flaw,
        message=None if clip.flaw is None else clip.flaw.meaning,
    )


def _media_type(request: Request) -> str:
    return request.headers.get("content-type", "").partition(";")[0].strip().lower()


def _identify(
    caller: Principal, user: User, body: bytes, token: str | None
) -> idempotency.Request | None:
    if token is None:
        return None
    return idempotency.Request(
        key_id=caller.key_id,
        user_uuid=user.uuid,
        route=ROUTE,
        token=token,
        body_sha256=hashlib.sha256(body).hexdigest(),
    )


async def _parse(content_type: str, body: bytes, user: User, settings: Settings) -> Upload:
    rules = UploadRules(
        sensor=Sensor(user.skeleton, user.up, settings.coordinate_max_m),
        clips=settings.clips,
        frames_per_clip=settings.frames_per_clip,
    )
    if len(body) <= INLINE_BYTES and not content_type.lower().startswith(FORM_TYPE):
        return await run_in_threadpool(parse_upload, content_type, body, rules)
    return await read_upload(
        content_type,
        body,
        rules,
        timeout_s=settings.parse_timeout_s,
        memory_bytes=settings.parse_bytes,
    )


async def _store(
    database: Database,
    user: User,
    upload: Upload,
    caller: Principal,
    wanted: idempotency.Request | None,
) -> idempotency.Answer:
    """Store the trial, its job and the answer to the same request; whoever is second gets that."""
    now = utc_now()
    async with database.lock(f"trials/{user.uuid}") as tx:
        if wanted is not None:
            known = await idempotency.find(tx, wanted, now=now)
            if known is not None:
                return known
        recorded = await store_upload(
            tx,
            user,
            label=upload.label,
            finetune=upload.finetune,
            clips=upload.clips,
            requested_by=caller.key_id,
        )
        answer = idempotency.Answer(202, _show(recorded).model_dump_json().encode())
        if wanted is not None:
            await idempotency.remember(tx, wanted, answer, now=now)
    return answer


def _show(recorded: Recorded) -> RecordedOut:
    job = None if recorded.job is None else JobOut.model_validate(recorded.job)
    return RecordedOut(trial=show_trial(recorded.trial), job=job)


def _respond(request: Request, answer: idempotency.Answer) -> Response:
    if wants_msgpack(request, _media_type(request)):
        content = msgspec.msgpack.encode(msgspec.json.decode(answer.content))
        return Response(content, answer.status, media_type=MSGPACK_TYPE)
    return Response(answer.content, answer.status, media_type=JSON_TYPE)
