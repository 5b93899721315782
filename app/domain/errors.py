"""Everything that can go wrong on purpose, in one tree, each with a stable code.

A code never changes once released: clients branch on it. ``app.api.errors`` has the status of each.

    KinecastError
    ├── DeniedError
    │   ├── UnauthorizedError         unauthorized         no key, a wrong key or a revoked one
    │   └── ForbiddenError            forbidden            the key is good, but not for this
    ├── MissingError                  not_found            no such page or row
    │   ├── UnknownUserError          unknown_user
    │   ├── UnknownKeyError           unknown_key
    │   ├── UnknownVersionError       unknown_version
    │   ├── UnknownTrialError         unknown_trial
    │   └── UnknownJobError           unknown_job
    ├── ConflictError                 conflict
    │   ├── UserExistsError           user_exists
    │   ├── VersionUnavailableError   version_unavailable  a pinned version that cannot be used now
    │   ├── TrialConflictError        trial_conflict       the trial is not in a state for that
    │   ├── JobQueuedError            job_queued           a job with other trials waits already
    │   ├── ActiveChangedError        active_changed       another version is active than expected
    │   └── FencedError               fenced               a newer stream took its session over
    ├── InvalidError                  invalid_request      with the list of what is wrong where
    │   ├── LimitExceededError        limit_exceeded       with the name of the limit
    │   │   └── TrialLimitError       trial_limit          a recording got too long
    │   ├── UnknownFieldError         unknown_field
    │   ├── BadConfigureError         bad_configure
    │   ├── KeyReusedError            idempotency_key_reused
    │   ├── BadRecordingError         bad_recording        a file that cannot be read
    │   ├── NothingToTrainOnError     nothing_to_train_on
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
    │   ├── UserDeletedError          user_deleted
    │   ├── WeightsPurgedError        weights_purged       the figures are kept, the weights not
    │   └── WeightsDamagedError       weights_damaged      they are not what was stored
    ├── UnavailableError              unavailable          try again, here or at another replica
    │   ├── NotReadyError             not_ready
    │   ├── OverloadedError           overloaded
    │   ├── TrialUnavailableError     trial_unavailable    nothing can be stored at the moment
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

    def __init_subclass__(cls, *, code: str, title: str, retryable: bool | None = None) -> None:
        cls.code, cls.title = code, title
        if retryable is not None:
            cls.retryable = retryable

    def __init__(self, message: str | None = None) -> None:
        self.message = message or self.title
        super().__init__(self.message)


class DeniedError(KinecastError, code="denied", title="Access denied"):
    """The caller may not do this."""


class UnauthorizedError(DeniedError, code="unauthorized", title="A valid API key is needed"):
    """No key, an unknown key, a wrong secret or a revoked key: the answer never says which."""


class ForbiddenError(DeniedError, code="forbidden", title="This key may not do that"):
    """The key lacks a scope, or is bound to another user."""


class MissingError(KinecastError, code="not_found", title="Not found"):
    """No such page or row."""


class UnknownUserError(MissingError, code="unknown_user", title="No such user"):
    """No user of that id."""


class UnknownKeyError(MissingError, code="unknown_key", title="No such key"):
    """No API key of that id."""


class UnknownVersionError(MissingError, code="unknown_version", title="No such version"):
    """This user never had a version of that number."""


class UnknownTrialError(MissingError, code="unknown_trial", title="No such trial"):
    """This user has no trial of that id."""


class UnknownJobError(MissingError, code="unknown_job", title="No such job"):
    """No job of that id."""


class ConflictError(KinecastError, code="conflict", title="In conflict with what is stored"):
    """What is stored does not allow this now."""


class UserExistsError(ConflictError, code="user_exists", title="A user of this id exists"):
    """The id is taken."""


class VersionUnavailableError(
    ConflictError, code="version_unavailable", title="The pinned version cannot be used"
):
    """A pinned version cannot be used; it is never replaced silently."""


class TrialConflictError(
    ConflictError, code="trial_conflict", title="The trial is not in a state for that"
):
    """The trial is not in a state for that, or its id belongs to another."""


class JobQueuedError(ConflictError, code="job_queued", title="A job waits already"):
    """An explicit list of trials is never merged with a job that waits already."""


class ActiveChangedError(
    ConflictError, code="active_changed", title="Another version is active than expected"
):
    """Somebody else changed the active version in between; look again before deciding."""


class FencedError(ConflictError, code="fenced", title="A newer stream took this session over"):
    """A newer stream took this session's name over; this one must not come back by itself."""


class InvalidError(KinecastError, code="invalid_request", title="The request is not valid"):
    """The request is understood and wrong.

    Attributes:
        errors: each wrong place; empty where the message says it all.
    """

    def __init__(self, message: str | None = None, *, errors: tuple[FieldError, ...] = ()) -> None:
        super().__init__(message)
        self.errors = errors


class LimitExceededError(InvalidError, code="limit_exceeded", title="A limit is exceeded"):
    """More than a limit of ``GET /v1/limits`` allows.

    Attributes:
        limit: name of the limit.
    """

    def __init__(
        self, message: str | None = None, *, limit: str, errors: tuple[FieldError, ...] = ()
    ) -> None:
        super().__init__(message, errors=errors)
        self.limit = limit


class TrialLimitError(LimitExceededError, code="trial_limit", title="The recording is too long"):
    """A clip of a recording has ended at a limit of ``hello.limits``; what is stored stays."""


class UnknownFieldError(InvalidError, code="unknown_field", title="Unknown field"):
    """A field that the server does not know: refused, so that a typing error cannot pass."""


class BadConfigureError(
    InvalidError, code="bad_configure", title="These stream settings are not valid"
):
    """Settings of a stream that make no sense."""


class KeyReusedError(
    InvalidError, code="idempotency_key_reused", title="This Idempotency-Key had another body"
):
    """The same `Idempotency-Key` came with another body within a day."""


class BadRecordingError(InvalidError, code="bad_recording", title="The recording cannot be read"):
    """An uploaded file that is not what it should be; the message names it."""


class NothingToTrainOnError(
    InvalidError, code="nothing_to_train_on", title="There is no stored trial to train on"
):
    """Fine-tuning was asked for, and there is nothing that it could use."""


class LayoutMismatchError(
    InvalidError,
    code="layout_mismatch",
    title="The joint names are not those of the user's skeleton",
):
    """The client's joint names are not those of the user's skeleton."""


class BadFrameError(InvalidError, code="bad_frame", title="The frame is not valid"):
    """Coordinates, times or confidences that no sensor can have meant."""


class NanInJsonError(
    BadFrameError,
    code="nan_in_json",
    title="JSON has no NaN or Infinity: send null in place of a missing joint",
):
    """NaN or Infinity in JSON, where they do not exist."""


class WrongJointCountError(BadFrameError, code="wrong_joint_count", title="Wrong number of joints"):
    """Another number of joints than the user's skeleton has."""


class SeqNotIncreasingError(BadFrameError, code="seq_not_increasing", title="seq must increase"):
    """``seq`` must grow with every frame, also over reconnects."""


class TimeNotIncreasingError(BadFrameError, code="t_not_increasing", title="t must increase"):
    """``t`` must grow with every frame."""


class BadTimeUnitError(BadFrameError, code="bad_time_unit", title="t is not in seconds"):
    """The steps of ``t`` are no seconds of a 12 to 120 Hz sensor."""


class StaleFrameError(
    BadFrameError, code="stale_frame", title="The frame is too old", retryable=True
):
    """Older than ``max_age_ms``: a forecast from it would come too late."""


class NoForecastError(
    InvalidError, code="no_forecast", title="No forecast is possible from these frames"
):
    """The frames are good, but nothing can be forecast from them."""


class TooLittleHistoryError(
    NoForecastError, code="too_little_history", title="The frames span too little time"
):
    """The frames span less than a window."""


class GapInHistoryError(NoForecastError, code="gap_in_history", title="The window has a gap"):
    """Neighbouring frames are too far apart within the window."""


class PersonLostError(
    NoForecastError, code="person_lost", title="The person is not seen well enough"
):
    """No hip centre, or over half of the joints missing."""


class TransportError(KinecastError, code="bad_request", title="The request cannot be read"):
    """The request does not reach any meaning: framing, format, size or rate."""


class BadMessageError(TransportError, code="bad_message", title="The message cannot be read"):
    """Not an object, or broken framing."""


class TooManyErrorsError(TransportError, code="too_many_errors", title="Too many wrong messages"):
    """A stream whose messages keep being wrong."""


class MethodNotAllowedError(
    TransportError, code="method_not_allowed", title="This method is not allowed here"
):
    """The page exists, not with this method."""


class UnsupportedMediaTypeError(
    TransportError, code="unsupported_media_type", title="Unsupported request format"
):
    """A body in another format than the route reads."""


class UnsupportedSubprotocolError(
    TransportError, code="unsupported_subprotocol", title="Unsupported WebSocket subprotocol"
):
    """None of the WebSocket subprotocols that the server speaks."""


class TooLargeError(TransportError, code="too_large", title="Too many bytes"):
    """More bytes than allowed."""


class TooFastError(TransportError, code="too_fast", title="Too many requests", retryable=True):
    """More often than allowed.

    Attributes:
        retry_after_s: seconds to wait before the next attempt.
    """

    def __init__(self, message: str | None = None, *, retry_after_s: float = 1.0) -> None:
        super().__init__(message)
        self.retry_after_s = retry_after_s


class IdleError(
    TransportError, code="idle", title="The stream was idle for too long", retryable=True
):
    """A stream without messages."""


class GoneError(KinecastError, code="gone", title="Gone"):
    """It was here."""


class UserDeletedError(GoneError, code="user_deleted", title="The user was deleted"):
    """The user was erased while a stream of theirs was open."""


class WeightsPurgedError(GoneError, code="weights_purged", title="The weights were removed"):
    """Old weights are removed after a while; the figures of the version are kept."""


class WeightsDamagedError(GoneError, code="weights_damaged", title="The weights are damaged"):
    """The stored bytes are not those of their sha256; they are neither used nor handed out."""


class UnavailableError(
    KinecastError, code="unavailable", title="Not available right now", retryable=True
):
    """Not now; here or at another replica it may work.

    Attributes:
        retry_after_s: seconds to wait before the next attempt.
    """

    def __init__(self, message: str | None = None, *, retry_after_s: float = 1.0) -> None:
        super().__init__(message)
        self.retry_after_s = retry_after_s


class NotReadyError(UnavailableError, code="not_ready", title="The service is not ready"):
    """Starting, or the database cannot be reached."""


class OverloadedError(UnavailableError, code="overloaded", title="The service is overloaded"):
    """More work than this replica can do in time."""


class TrialUnavailableError(UnavailableError, code="trial_unavailable", title="Nothing is stored"):
    """The database is away: a recording waits in memory, until its oldest frames are lost."""


class DrainingError(UnavailableError, code="draining", title="This replica is shutting down"):
    """This replica is about to stop."""


class InternalError(KinecastError, code="internal_error", title="Internal error", retryable=True):
    """A defect of the service. The details are in its log, never in the answer."""


class StartError(KinecastError, code="cannot_start", title="The service cannot start"):
    """The service cannot start like this."""


class MigrationError(
    StartError, code="database_not_migrated", title="The database does not fit this version"
):
    """The database has other tables than this version needs."""
