"""One table: which HTTP status and WebSocket close code each error gets. And one shape to say it.

Every error leaves as RFC 9457 `application/problem+json`; none carries a traceback.
"""

import http
from typing import Any, NamedTuple

import structlog
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException

from app.domain import errors
from app.domain.errors import FieldError, InvalidError, KinecastError

PROBLEM_TYPE = "application/problem+json"
MAX_FIELD_ERRORS = 20
"""A request can be wrong in ten thousand places; the first ones help, the rest only weigh."""

log = structlog.get_logger(__name__)


class Answer(NamedTuple):
    """How an error is told.

    Attributes:
        status: of an HTTP response.
        close_code: of a WebSocket, where the error ends it; None where the stream goes on.
    """

    status: int
    close_code: int | None


ANSWERS: dict[type[KinecastError], Answer] = {
    errors.KinecastError: Answer(500, 1011),
    errors.DeniedError: Answer(403, 4403),
    errors.UnauthorizedError: Answer(401, 4401),
    errors.ForbiddenError: Answer(403, 4403),
    errors.MissingError: Answer(404, None),
    errors.UnknownUserError: Answer(404, 4404),
    errors.ConflictError: Answer(409, None),
    errors.FencedError: Answer(409, 4409),
    errors.InvalidError: Answer(422, None),
    errors.TransportError: Answer(400, 4400),
    errors.MethodNotAllowedError: Answer(405, None),
    errors.UnsupportedSubprotocolError: Answer(406, 4406),
    errors.IdleError: Answer(408, 4408),
    errors.TooLargeError: Answer(413, 4413),
    errors.UnsupportedMediaTypeError: Answer(415, None),
    errors.TooFastError: Answer(429, 4429),
    errors.GoneError: Answer(410, None),
    errors.UserDeletedError: Answer(410, 4410),
    errors.UnavailableError: Answer(503, 1011),
    errors.OverloadedError: Answer(503, None),
    errors.TrialUnavailableError: Answer(503, None),
    errors.DrainingError: Answer(503, 1001),
    errors.InternalError: Answer(500, 1011),
}
"""An error that is not listed answers as the nearest one above it in the tree."""

_BY_STATUS: dict[int, type[KinecastError]] = {
    400: errors.TransportError,
    401: errors.UnauthorizedError,
    403: errors.ForbiddenError,
    404: errors.MissingError,
    405: errors.MethodNotAllowedError,
    413: errors.TooLargeError,
    415: errors.UnsupportedMediaTypeError,
}


def find_answer(error: type[KinecastError]) -> Answer:
    """Look an error up in the table, or the nearest one above it."""
    return next(ANSWERS[kind] for kind in error.__mro__ if kind in ANSWERS)


def _clean(text: str) -> str:
    """Replace what no encoding can send, such as half a surrogate pair of a client's string."""
    return text.encode("utf-8", "replace").decode()


def describe(error: KinecastError) -> dict[str, Any]:
    """Write an error as the members of a problem."""
    problem: dict[str, Any] = {
        "type": f"urn:kinecast:error:{error.code}",
        "title": error.title,
        "status": find_answer(type(error)).status,
        "detail": _clean(error.message),
        "code": error.code,
    }
    if isinstance(error, InvalidError):
        shown = error.errors[:MAX_FIELD_ERRORS] or (FieldError(("body",), error.message),)
        problem["errors"] = [{"loc": list(item.loc), "msg": _clean(item.msg)} for item in shown]
    if isinstance(error, errors.LimitExceededError):
        problem["limit"] = error.limit
    return problem


def to_response(error: KinecastError) -> JSONResponse:
    """Answer a request with an error."""
    headers: dict[str, str] = {}
    if isinstance(error, errors.UnauthorizedError):
        headers["WWW-Authenticate"] = "Bearer"
    if isinstance(error, errors.TooFastError | errors.UnavailableError):
        headers["Retry-After"] = str(max(1, round(error.retry_after_s)))
    problem = describe(error)
    return JSONResponse(problem, problem["status"], headers, media_type=PROBLEM_TYPE)


def install(app: FastAPI) -> None:
    """Make the application answer every error in this shape."""
    app.add_exception_handler(KinecastError, _answer_ours)
    app.add_exception_handler(RequestValidationError, _answer_invalid)
    app.add_exception_handler(HTTPException, _answer_framework)
    app.add_exception_handler(Exception, _answer_defect)


def to_field_errors(found: list[Any]) -> tuple[FieldError, ...]:
    """Take place and message out of Pydantic's errors; never the value, which may be a secret."""
    return tuple(FieldError(tuple(item["loc"]), item["msg"]) for item in found)


def explain_validation(found: list[Any]) -> InvalidError:
    """Make one error of all that Pydantic found wrong with a request."""
    fields = to_field_errors(found[:MAX_FIELD_ERRORS])
    first = ".".join(str(part) for part in fields[0].loc)
    message = f"{first}: {fields[0].msg}"
    if all(item["type"] == "extra_forbidden" for item in found):
        return errors.UnknownFieldError(message, errors=fields)
    return InvalidError(message, errors=fields)


async def _answer_ours(request: Request, error: Exception) -> JSONResponse:
    del request
    if not isinstance(error, KinecastError):  # the signature is the framework's
        raise error
    return to_response(error)


async def _answer_invalid(request: Request, error: Exception) -> JSONResponse:
    del request
    if not isinstance(error, RequestValidationError):
        raise error
    return to_response(explain_validation(list(error.errors())))


async def _answer_framework(request: Request, error: Exception) -> JSONResponse:
    """Say in our shape what the framework refused by itself."""
    if not isinstance(error, HTTPException):
        raise error
    kind = _BY_STATUS.get(error.status_code, errors.InternalError)
    phrase = http.HTTPStatus(error.status_code).phrase
    response = to_response(kind(f"{request.method} {request.url.path}: {phrase}."))
    response.headers.update(error.headers or {})
    return response


async def _answer_defect(request: Request, error: Exception) -> JSONResponse:
    """Log what went wrong, and answer only that something did."""
    log.error("request failed", method=request.method, path=request.url.path, exc_info=error)
    return to_response(errors.InternalError("The service failed to answer; its log says why."))
