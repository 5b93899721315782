"""Everything that can go wrong on purpose, in one tree, each with a stable code.

A code never changes once released; clients branch on it. Which HTTP status or WebSocket close
code an error gets is decided in one table, ``app.api.errors``.

    KinecastError
    ├── DeniedError
    │   ├── UnauthorizedError         unauthorized         no key, a wrong key or a revoked one
    │   └── ForbiddenError            forbidden            the key is good, but not for this
    ├── MissingError                  not_found            no such page or row
    │   ├── UnknownUserError          unknown_user
    │   ├── UnknownKeyError           unknown_key
    │   └── UnknownVersionError       unknown_version
    ├── ConflictError                 conflict
    │   ├── UserExistsError           user_exists
    │   ├── VersionUnavailableError   version_unavailable  a pinned version that cannot be used now
    │   ├── TrialUnavailableError     trial_unavailable    this server records nothing
    │   └── FencedError               fenced               a newer stream took its session over
    ├── InvalidError                  invalid_request      with the list of what is wrong where
    │   ├── LimitExceededError        limit_exceeded       with the name of the limit
    │   ├── UnknownFieldError         unknown_field
    │   ├── BadConfigureError         bad_configure
    │   ├── LayoutMismatchError       layout_mismatch      the client means other joints
    │   ├── BadFrameError             bad_frame            what a person's pose can never be
    │   │   ├── NanInJsonError        nan_in_json
    │   │   ├── WrongJointCountError  wrong_joint_count
    │   │   ├── SeqNotIncreasingError seq_not_increasing
    │   │   ├── TimeNotIncreasingError t_not_increasing
    │   │   ├── BadTimeUnitError      bad_time_unit
    │   │   └── StaleFrameError       stale_frame
    │   └── NoForecastError           no_forecast          frames are good, but not enough to go on
    │       ├── TooLittleHistoryError too_little_history
    │       ├── GapInHistoryError     gap_in_history
    │       └── PersonLostError       person_lost
    ├── TransportError                bad_request          the request is no request of ours
    │   ├── BadMessageError           bad_message          not an object, or broken framing
    │   ├── TooManyErrorsError        too_many_errors
    │   ├── MethodNotAllowedError     method_not_allowed
    │   ├── UnsupportedMediaTypeError unsupported_media_type
    │   ├── UnsupportedSubprotocolError unsupported_subprotocol
    │   ├── TooLargeError             too_large
    │   ├── TooFastError              too_fast
    │   └── IdleError                 idle
    ├── GoneError                     gone
    │   └── UserDeletedError          user_deleted
    ├── UnavailableError              unavailable          try again, here or at another replica
    │   ├── NotReadyError             not_ready
    │   ├── OverloadedError           overloaded
    │   └── DrainingError             draining
    ├── InternalError                 internal_error       a defect; never says more than that
    └── StartError                    cannot_start         only on the command line
        └── MigrationError            database_not_migrated
"""

from dataclasses import dataclass
from typing import ClassVar


@dataclass(frozen=True, slots=True)
class FieldError:
    """One wrong place in a request: the path to it and what is wrong there."""

    loc: tuple[str | int, ...]
    msg: str


class KinecastError(Exception):
    """Root of the tree.

    Attributes:
        code: stable name that clients branch on.
        title: one short sentence, the same for every error of the code.
        retryable: whether the same request may succeed later without a change.
        message: what happened this time, for a person; never holds a secret or a pose.
    """

    code: ClassVar[str] = "error"
    title: ClassVar[str] = "Something went wrong"
    retryable: ClassVar[bool] = False

    def __init__(self, message: str | None = None) -> None:
        self.message = message or self.title
        super().__init__(self.message)


class DeniedError(KinecastError):
    """The caller may not do this."""

    code = "denied"
    title = "Access denied"


class UnauthorizedError(DeniedError):
    """No key, an unknown key, a wrong secret or a revoked key: the answer never says which."""

    code = "unauthorized"
    title = "A valid API key is needed"


class ForbiddenError(DeniedError):
    """The key lacks a scope, or is bound to another user."""

    code = "forbidden"
    title = "This key may not do that"


class MissingError(KinecastError):
    """No such page or row."""

    code = "not_found"
    title = "Not found"


class UnknownUserError(MissingError):
    """No user of that id."""

    code = "unknown_user"
    title = "No such user"


class UnknownKeyError(MissingError):
    """No API key of that id."""

    code = "unknown_key"
    title = "No such key"


class UnknownVersionError(MissingError):
    """This user never had a version of that number."""

    code = "unknown_version"
    title = "No such version"


class ConflictError(KinecastError):
    """What is stored does not allow this now."""

    code = "conflict"
    title = "In conflict with what is stored"


class UserExistsError(ConflictError):
    """The id is taken."""

    code = "user_exists"
    title = "A user of this id exists"


class VersionUnavailableError(ConflictError):
    """A pinned version cannot be used; it is never replaced silently."""

    code = "version_unavailable"
    title = "The pinned version cannot be used"


class TrialUnavailableError(ConflictError):
    """A recording was asked for where none can be made."""

    code = "trial_unavailable"
    title = "Recording is not enabled on this server"


class FencedError(ConflictError):
    """A newer stream took this session's name over; this one must not come back by itself."""

    code = "fenced"
    title = "A newer stream took this session over"


class InvalidError(KinecastError):
    """The request is understood and wrong.

    Attributes:
        errors: each wrong place; empty where the message says it all.
    """

    code = "invalid_request"
    title = "The request is not valid"

    def __init__(self, message: str | None = None, *, errors: tuple[FieldError, ...] = ()) -> None:
        super().__init__(message)
        self.errors = errors


class LimitExceededError(InvalidError):
    """More than a limit of ``GET /v1/limits`` allows.

    Attributes:
        limit: name of the limit.
    """

    code = "limit_exceeded"
    title = "A limit is exceeded"

    def __init__(
        self, message: str | None = None, *, limit: str, errors: tuple[FieldError, ...] = ()
    ) -> None:
        super().__init__(message, errors=errors)
        self.limit = limit


class UnknownFieldError(InvalidError):
    """A field that the server does not know: refused, so that a typing error cannot pass."""

    code = "unknown_field"
    title = "Unknown field"


class BadConfigureError(InvalidError):
    """Settings of a stream that make no sense."""

    code = "bad_configure"
    title = "These stream settings are not valid"


class LayoutMismatchError(InvalidError):
    """The client's joint names are not those of the user's skeleton."""

    code = "layout_mismatch"
    title = "The joint names are not those of the user's skeleton"


class BadFrameError(InvalidError):
    """Coordinates, times or confidences that no sensor can have meant."""

    code = "bad_frame"
    title = "The frame is not valid"


class NanInJsonError(BadFrameError):
    """NaN or Infinity in JSON, where they do not exist."""

    code = "nan_in_json"
    title = "JSON has no NaN or Infinity: send null in place of a missing joint"


class WrongJointCountError(BadFrameError):
    """Another number of joints than the user's skeleton has."""

    code = "wrong_joint_count"
    title = "Wrong number of joints"


class SeqNotIncreasingError(BadFrameError):
    """``seq`` must grow with every frame, also over reconnects."""

    code = "seq_not_increasing"
    title = "seq must increase"


class TimeNotIncreasingError(BadFrameError):
    """``t`` must grow with every frame."""

    code = "t_not_increasing"
    title = "t must increase"


class BadTimeUnitError(BadFrameError):
    """The steps of ``t`` are no seconds of a 12 to 120 Hz sensor."""

    code = "bad_time_unit"
    title = "t is not in seconds"


class StaleFrameError(BadFrameError):
    """Older than ``max_age_ms``: a forecast from it would come too late."""

    code = "stale_frame"
    title = "The frame is too old"
    retryable = True


class NoForecastError(InvalidError):
    """The frames are good, but nothing can be forecast from them."""

    code = "no_forecast"
    title = "No forecast is possible from these frames"


class TooLittleHistoryError(NoForecastError):
    """The frames span less than a window."""

    code = "too_little_history"
    title = "The frames span too little time"


class GapInHistoryError(NoForecastError):
    """Neighbouring frames are too far apart within the window."""

    code = "gap_in_history"
    title = "The window has a gap"


class PersonLostError(NoForecastError):
    """No hip centre, or over half of the joints missing."""

    code = "person_lost"
    title = "The person is not seen well enough"


class TransportError(KinecastError):
    """The request does not reach any meaning: framing, format, size or rate."""

    code = "bad_request"
    title = "The request cannot be read"


class BadMessageError(TransportError):
    """Not an object, or broken framing."""

    code = "bad_message"
    title = "The message cannot be read"


class TooManyErrorsError(TransportError):
    """A stream whose messages keep being wrong."""

    code = "too_many_errors"
    title = "Too many wrong messages"


class MethodNotAllowedError(TransportError):
    """The page exists, not with this method."""

    code = "method_not_allowed"
    title = "This method is not allowed here"


class UnsupportedMediaTypeError(TransportError):
    """A body in another format than the route reads."""

    code = "unsupported_media_type"
    title = "Unsupported request format"


class UnsupportedSubprotocolError(TransportError):
    """None of the WebSocket subprotocols that the server speaks."""

    code = "unsupported_subprotocol"
    title = "Unsupported WebSocket subprotocol"


class TooLargeError(TransportError):
    """More bytes than allowed."""

    code = "too_large"
    title = "Too many bytes"


class TooFastError(TransportError):
    """More often than allowed.

    Attributes:
        retry_after_s: seconds to wait before the next attempt.
    """

    code = "too_fast"
    title = "Too many requests"
    retryable = True

    def __init__(self, message: str | None = None, *, retry_after_s: float = 1.0) -> None:
        super().__init__(message)
        self.retry_after_s = retry_after_s


class IdleError(TransportError):
    """A stream without messages."""

    code = "idle"
    title = "The stream was idle for too long"
    retryable = True


class GoneError(KinecastError):
    """It was here."""

    code = "gone"
    title = "Gone"


class UserDeletedError(GoneError):
    """The user was erased while a stream of theirs was open."""

    code = "user_deleted"
    title = "The user was deleted"


class UnavailableError(KinecastError):
    """Not now; here or at another replica it may work.

    Attributes:
        retry_after_s: seconds to wait before the next attempt.
    """

    code = "unavailable"
    title = "Not available right now"
    retryable = True

    def __init__(self, message: str | None = None, *, retry_after_s: float = 1.0) -> None:
        super().__init__(message)
        self.retry_after_s = retry_after_s


class NotReadyError(UnavailableError):
    """Starting, or the database cannot be reached."""

    code = "not_ready"
    title = "The service is not ready"


class OverloadedError(UnavailableError):
    """More work than this replica can do in time."""

    code = "overloaded"
    title = "The service is overloaded"


class DrainingError(UnavailableError):
    """This replica is about to stop."""

    code = "draining"
    title = "This replica is shutting down"


class InternalError(KinecastError):
    """A defect of the service. The details are in its log, never in the answer."""

    code = "internal_error"
    title = "Internal error"
    retryable = True


class StartError(KinecastError):
    """The service cannot start like this."""

    code = "cannot_start"
    title = "The service cannot start"


class MigrationError(StartError):
    """The database has other tables than this version needs."""

    code = "database_not_migrated"
    title = "The database does not fit this version"
