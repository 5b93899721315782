"""Everything that the client raises on purpose.

KinecastError
├── UnreachableError        nobody answers at the address
├── DeadlineError           no answer in time (a TimeoutError as well)
├── AnswerError             an answer that makes no sense: not a Kinecast service, or a newer one
├── FrameError              what was handed over is no frame (a ValueError as well)
├── RecordingError          a recording that cannot go on
├── ApiError                a request was answered with a problem
│   ├── UnauthorizedError   401: no key, a wrong one, or a revoked one
│   ├── ForbiddenError      403: the key may not do this
│   ├── NotFoundError       404, 410: there is no such thing, or not any more
│   ├── ConflictError       409: what is stored does not allow this now
│   ├── InvalidError        400, 406, 413, 415, 422: the request is wrong
│   └── BusyError           408, 429, 503: try again after `retry_after_s`
└── StoppedError            a stream that ended for good and does not come back by itself
    ├── RefusedError        the service refuses it: key, user, settings or messages are wrong
    ├── FencedError         a newer stream took the session's name over
    └── UserDeletedError    the user was erased
"""


class KinecastError(Exception):
    """Base of everything that this client raises on purpose."""


class UnreachableError(KinecastError):
    """Nobody answers at the address."""


class DeadlineError(KinecastError, TimeoutError):
    """No answer came in time."""


class AnswerError(KinecastError):
    """An answer that makes no sense: not a Kinecast service, or one that is newer than this."""


class FrameError(KinecastError, ValueError):
    """What was handed over is no frame of this person: a shape, a type or a time is wrong."""


class RecordingError(KinecastError):
    """A recording that cannot go on.

    Attributes:
        code: the stable name of the service's error.
    """

    def __init__(self, code: str, message: str) -> None:
        super().__init__(f"{code}: {message}")
        self.code = code


class ApiError(KinecastError):
    """A request was answered with a problem.

    Attributes:
        status: of the HTTP response.
        code: the stable name of the error: branch on it.
        detail: what was wrong, for people.
        errors: for wrong requests, each wrong place as `{"loc", "msg"}`.
        retry_after_s: when to try again, where the service said so.
    """

    def __init__(
        self,
        status: int,
        code: str,
        detail: str,
        *,
        errors: tuple[dict[str, object], ...] = (),
        retry_after_s: float | None = None,
    ) -> None:
        super().__init__(f"{code}: {detail}")
        self.status, self.code, self.detail = status, code, detail
        self.errors, self.retry_after_s = errors, retry_after_s


class UnauthorizedError(ApiError):
    """No key, a wrong one, or a revoked one."""


class ForbiddenError(ApiError):
    """The key may not do this, or not for this user."""


class NotFoundError(ApiError):
    """There is no such thing, or not any more."""


class ConflictError(ApiError):
    """What is stored does not allow this now."""


class InvalidError(ApiError):
    """The request is wrong; `errors` names the places."""


class BusyError(ApiError):
    """Not now; `retry_after_s` tells when to try again."""


class StoppedError(KinecastError):
    """A stream that ended for good and does not come back by itself.

    Attributes:
        close_code: of the WebSocket.
        code: the stable name of the service's error.
        detail: what was wrong, for people.
    """

    def __init__(self, close_code: int, code: str, detail: str) -> None:
        super().__init__(f"{code}: {detail} (closed with {close_code})")
        self.close_code, self.code, self.detail = close_code, code, detail


class RefusedError(StoppedError):
    """The service refuses the stream: its key, user, settings or messages are wrong."""


class FencedError(StoppedError):
    """A newer stream took the session's name over; coming back would fight with it for ever."""


class UserDeletedError(StoppedError):
    """The user was erased."""


_BY_STATUS: dict[int, type[ApiError]] = {
    400: InvalidError,
    401: UnauthorizedError,
    403: ForbiddenError,
    404: NotFoundError,
    406: InvalidError,
    408: BusyError,
    409: ConflictError,
    410: NotFoundError,
    413: InvalidError,
    415: InvalidError,
    422: InvalidError,
    429: BusyError,
    503: BusyError,
}

_STOPS: dict[int, type[StoppedError]] = {
    4400: RefusedError,
    4401: RefusedError,
    4403: RefusedError,
    4404: RefusedError,
    4406: RefusedError,
    4409: FencedError,
    4410: UserDeletedError,
    4413: RefusedError,
}

FINAL_CLOSES = frozenset(_STOPS)
"""Close codes after which a stream does not come back; after every other one it does."""


def find_api_error(status: int) -> type[ApiError]:
    """Give the exception of an HTTP status."""
    return _BY_STATUS.get(status, ApiError)


def find_stop(close_code: int) -> type[StoppedError]:
    """Give the exception of a final close code."""
    return _STOPS.get(close_code, StoppedError)
