"""`POST /v1/users/{user}/forecast`: one forecast from one request."""

import asyncio
import time
from dataclasses import asdict, dataclass
from functools import partial
from typing import Annotated, Any

import msgspec
import numpy as np
from fastapi import APIRouter, Depends, Request, Response
from pydantic import (
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
)
from pydantic_core import PydanticCustomError

from app.api.arrays import to_lists, to_wire
from app.api.bodies import (
    BINARY,
    JSON_TYPE,
    MSGPACK_TYPE,
    Confidence,
    Poses,
    Times,
    check_shapes,
    decode_body,
    explain_body,
    wants_msgpack,
)
from app.api.dependencies import (
    PathUser,
    Predictor,
    SettingsNeeded,
    get_settings,
)
from app.api.openapi import DENIED, needs, problems
from app.api.schemas import AnswerModel, RequestModel, VersionOut
from app.domain import errors
from app.domain.access import Scope
from app.domain.errors import (
    BadMessageError,
    FieldError,
    InternalError,
    InvalidError,
    LimitExceededError,
    NanInJsonError,
    UnsupportedMediaTypeError,
)
from app.domain.motion import RequestedVersion, Severity
from app.domain.users import User
from app.live.choosing import guard_choice
from app.live.engine import Engine
from app.live.forecasting import Answer, make_answer
from app.live.frames import WindowRules
from app.live.window import WindowReady, assemble
from app.live.work import Choice, EngineRequest, EngineResult
from app.settings import Settings
from models.skeleton import SKELETONS

router = APIRouter(tags=["forecast"])

FEW_FRAMES = 60
"""So many are put together at once; more of them in a thread."""
_MAX_VERSION = 2**31 - 1


def _check_version(value: object) -> object:
    """Say in one message what a version may be, not in one for each kind."""
    if value in ("active", "base") or (type(value) is int and 0 <= value <= _MAX_VERSION):
        return value
    raise PydanticCustomError("version", "must be 'active', 'base' or the number of a version")


class ForecastIn(RequestModel):
    """What was observed: at least 0.45 s of frames, the newest last."""

    model_config = ConfigDict(
        title="ForecastRequest",
        json_schema_extra={
            "examples": [
                {
                    "frames": [[[0.02, 0.71, 2.4], [0.02, 0.5, 2.41], None]],
                    "t": [12.034],
                    "version": "active",
                    "coverage": 0.9,
                }
            ]
        },
    )

    frames: Poses = Field(
        description="[time][joint][xyz] in metres, in the user's skeleton; null where missing."
    )
    t: Times | None = Field(
        None,
        description="Capture times in seconds, increasing; without them frames are 30 Hz and the "
        "newest is at 0.",
    )
    confidence: Confidence | None = Field(None, description="[time][joint], from 0 to 1.")
    version: Annotated[RequestedVersion, BeforeValidator(_check_version)] = Field(
        "active", description="Which weights; a number is used as it is, or refused."
    )
    coverage: Annotated[float, Field(gt=0, lt=1, strict=True)] | None = Field(
        None, description="Probability that `radius` is to have; 0.9 by default."
    )


class TimingOut(AnswerModel):
    """Where the time went."""

    queue_ms: float
    compute_ms: float
    total_ms: float


class ForecastOut(AnswerModel):
    """The next half second, in the skeleton and frame of reference of the request."""

    frames: list[list[list[float]]] = Field(description="[15][joint][xyz] in metres.")
    t: list[float] = Field(description="Times of the frames, on the clock of the request.")
    radius: list[list[float]] | None = Field(
        description="[15][joint] in metres: the joint lies within it with probability `coverage`."
    )
    coverage: float
    version: VersionOut
    quality: list[str] = Field(description="Flags; `GET /v1/quality` explains them.")
    severity: Severity
    filled: list[str] = Field(description="Joints that were missing and were carried.")
    timing: TimingOut


@dataclass(frozen=True, slots=True)
class _Body:
    """A request's body and the format in which to answer."""

    request: ForecastIn
    as_msgpack: bool


def forecast_body_limit(settings: Settings) -> int:
    """Give the most bytes that a forecast request of the most frames can need.

    In JSON a coordinate takes at most 25 bytes and a joint a few more; of the formats, the one
    with the most joints counts.
    """
    joints = max(len(skeleton.joints) for skeleton in SKELETONS.values())
    return 4096 + settings.forecast_frames * (joints * (4 * 25 + 8) + 64)


async def _read_body(request: Request, caller: Predictor) -> _Body:
    """Read the body after the caller is known, whatever the format."""
    del caller
    media_type = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if media_type not in {JSON_TYPE, MSGPACK_TYPE}:
        raise UnsupportedMediaTypeError(f"Send the body as {JSON_TYPE} or {MSGPACK_TYPE}.")
    body = await request.body()
    content = decode_body(body, as_msgpack=media_type == MSGPACK_TYPE)
    _check_length(content, get_settings(request).forecast_frames)
    try:
        parsed = ForecastIn.model_validate(content)
    except ValidationError as error:
        raise explain_body(error) from None
    return _Body(parsed, as_msgpack=wants_msgpack(request, media_type))


@router.post(
    "/v1/users/{user}/forecast",
    summary="Forecast the next half second",
    response_model=ForecastOut,
    openapi_extra={
        **needs(Scope.PREDICT),
        "requestBody": {
            "required": True,
            "content": {
                JSON_TYPE: {"schema": ForecastIn.model_json_schema()},
                MSGPACK_TYPE: {"schema": BINARY},
            },
        },
    },
    responses={
        200: {"content": {MSGPACK_TYPE: {"schema": BINARY}}},
        **problems(
            *DENIED,
            errors.UnknownUserError,
            errors.VersionUnavailableError,
            errors.TooLargeError,
            errors.UnsupportedMediaTypeError,
            BadMessageError,
            InvalidError,
            NanInJsonError,
            errors.WrongJointCountError,
            errors.TooLittleHistoryError,
            errors.PersonLostError,
            LimitExceededError,
            errors.OverloadedError,
        ),
    },
)
async def forecast(
    caller: Predictor,
    user: PathUser,
    body: Annotated[_Body, Depends(_read_body)],
    settings: SettingsNeeded,
    request: Request,
) -> Response:
    """Forecast 15 frames at 30 Hz from at least 0.45 s of observed frames."""
    del caller
    started = time.perf_counter()
    state = request.app.state
    wanted = body.request
    choice = await state.library.choose(user.uuid, wanted.version)
    ready = await _assemble(wanted, user, choice, state.window_rules)
    choice = guard_choice(choice, ready.flags, wanted.version, resolve=state.decoders.resolve)
    coverage = settings.coverage if wanted.coverage is None else wanted.coverage
    window = EngineRequest(ready.window, wanted.version, coverage, choice)
    result = await _compute(state.engine, window)
    answer = make_answer(ready, result, skeleton=SKELETONS[user.skeleton], up=user.up)
    if not np.isfinite(answer.frames).all():
        raise InternalError("The forecast was not finite.")
    total_ms = round((time.perf_counter() - started) * 1e3, 3)
    return _respond(answer, total_ms=total_ms, as_msgpack=body.as_msgpack)


async def _assemble(
    wanted: ForecastIn, user: User, choice: Choice, rules: WindowRules
) -> WindowReady:
    """Make the window, beside the event loop where that takes long enough to hold up streams."""
    check_shapes(wanted.frames, wanted.t, wanted.confidence)
    work = partial(
        assemble,
        wanted.frames,
        wanted.t,
        wanted.confidence,
        skeleton=SKELETONS[user.skeleton],
        up=user.up,
        root_relative=user.root_relative,
        bones=choice.bones,
        rules=rules,
    )
    return await asyncio.to_thread(work) if len(wanted.frames) > FEW_FRAMES else work()


async def _compute(engine: Engine, request: EngineRequest) -> EngineResult:
    """Have a window forecast.

    Raises:
        VersionUnavailableError: a pinned personal version failed; nothing takes its place.
    """
    result = await asyncio.wrap_future(engine.submit(request))
    if result.version.replaces_pinned:
        raise errors.VersionUnavailableError(f"Version {request.version} failed.")
    return result


def _check_length(content: object, limit: int) -> None:
    """Refuse too many frames before looking at any of them."""
    frames = content.get("frames") if isinstance(content, dict) else None
    if isinstance(frames, dict):
        shape = frames.get("shape")
        length = shape[0] if isinstance(shape, list) and shape else 0
    else:
        length = len(frames) if isinstance(frames, list) else 0
    if isinstance(length, int) and length > limit:
        wrong = FieldError(("body", "frames"), f"{length} frames, at most {limit} are allowed")
        raise LimitExceededError(wrong.msg, limit="forecast_frames", errors=(wrong,))


def _respond(answer: Answer, *, total_ms: float, as_msgpack: bool) -> Response:
    timing = {**asdict(answer.timing), "total_ms": total_ms}
    rest: dict[str, Any] = {
        "coverage": answer.coverage,
        "version": asdict(answer.version),
        "quality": list(answer.quality),
        "severity": answer.severity.value,
        "filled": list(answer.filled),
        "timing": timing,
    }
    radius = answer.radius
    if as_msgpack:
        arrays = {
            "frames": to_wire(answer.frames, "<f4"),
            "t": to_wire(answer.t_out, "<f8"),
            "radius": None if radius is None else to_wire(radius, "<f4"),
        }
        return Response(msgspec.msgpack.encode({**arrays, **rest}), media_type=MSGPACK_TYPE)
    lists = {
        "frames": to_lists(answer.frames),
        "t": answer.t_out.tolist(),
        "radius": None if radius is None else to_lists(radius),
    }
    return Response(msgspec.json.encode({**lists, **rest}), media_type=JSON_TYPE)
