"""Requests and answers of the plain JSON routes. Requests refuse fields that they do not know."""

from datetime import datetime
from typing import Annotated, Any, Generic, Literal, TypeVar
from uuid import UUID

from pydantic import BaseModel, ConfigDict, Field, model_validator

from app.domain.access import Scope
from app.domain.jobs import JobReason, JobState
from app.domain.motion import Fallback, RequestedVersion, Severity, VersionKind
from app.domain.trials import TrialSource, TrialState
from app.domain.users import USER_ID_PATTERN, UpAxis
from app.domain.versions import VersionState
from models.skeleton import SKELETONS

Item = TypeVar("Item")
Name = Annotated[str, Field(min_length=1, max_length=200, pattern=r"^[^\x00-\x1f\x7f-\x9f]+$")]


def _examples(*examples: dict[str, Any]) -> dict[str, Any]:
    return {"examples": list(examples)}


class RequestModel(BaseModel):
    """What clients send."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class AnswerModel(BaseModel):
    """What clients get. Fields are added over time, so clients ignore what they do not know."""

    model_config = ConfigDict(from_attributes=True, frozen=True)


class FieldProblem(AnswerModel):
    """One wrong place in a request."""

    loc: list[str | int]
    msg: str


class Problem(AnswerModel):
    """An error, as of RFC 9457. `code` is stable: branch on it."""

    type: str
    title: str
    status: int
    detail: str
    code: str
    errors: list[FieldProblem] | None = Field(None, description="Only with status 422.")
    limit: str | None = Field(None, description="Only with code `limit_exceeded`.")


class PageOut(AnswerModel, Generic[Item]):
    """One page of a list, newest first."""

    items: list[Item]
    next_cursor: str | None = Field(description="Hand it back as `cursor`; null at the end.")


class VersionOut(AnswerModel):
    """Which weights a forecast comes from."""

    model_config = ConfigDict(
        json_schema_extra=_examples(
            {
                "number": 0,
                "kind": "base",
                "sha256": "9f2c…",
                "requested": "active",
                "share": 0.0,
                "fallback": None,
            }
        )
    )

    number: int | None
    kind: VersionKind
    sha256: str | None
    requested: RequestedVersion
    share: float
    fallback: Fallback | None


class UserIn(RequestModel):
    """A new user. `skeleton`, `up` and `root_relative` describe the sensor's poses."""

    model_config = ConfigDict(
        json_schema_extra=_examples(
            {"id": "ada", "skeleton": "kinect_v1", "up": "y", "display_name": "Ada"}
        )
    )

    id: str = Field(pattern=USER_ID_PATTERN, description="Case-sensitive.")
    skeleton: str = Field("kinect_v1", description="A name of `GET /v1/skeletons`.")
    up: UpAxis = "y"
    root_relative: bool = False
    display_name: Name | None = None

    @model_validator(mode="after")
    def _know_skeleton(self) -> "UserIn":
        if self.skeleton not in SKELETONS:
            raise ValueError(f"there is no skeleton {self.skeleton}; see GET /v1/skeletons")
        return self


class UserPatch(RequestModel):
    """What may change of a user."""

    model_config = ConfigDict(json_schema_extra=_examples({"display_name": "Ada L."}))

    display_name: Name | None = Field(None, description="Null takes the name away.")
    auto_promote: bool = Field(
        default=True,
        strict=True,
        description="Whether a version that wins becomes active by itself.",
    )


class UserOut(AnswerModel):
    """A user."""

    id: str
    skeleton: str
    up: UpAxis
    root_relative: bool
    display_name: str | None
    created_at: datetime
    auto_promote: bool = Field(description="A promotion or a rollback by hand turns it off.")
    version: VersionOut = Field(description="The active version.")


class KeyIn(RequestModel):
    """A new key."""

    model_config = ConfigDict(
        json_schema_extra=_examples(
            {"scopes": ["predict", "record"], "user": "ada", "name": "robot 7"}
        )
    )

    scopes: Annotated[frozenset[Scope], Field(min_length=1)]
    user: str | None = Field(None, description="The only user that the key may touch.")
    name: Name | None = None

    @model_validator(mode="after")
    def _keep_admins_free(self) -> "KeyIn":
        if self.user is not None and Scope.ADMIN in self.scopes:
            raise ValueError("an admin key cannot be bound to a user")
        return self


class KeyOut(AnswerModel):
    """A key, without its secret."""

    id: UUID
    name: str | None
    scopes: frozenset[Scope]
    user: str | None
    created_at: datetime
    revoked_at: datetime | None
    last_used_at: datetime | None = Field(description="To the hour.")


class NewKeyOut(KeyOut):
    """A key that was just made."""

    key: str = Field(description="The key itself; it is shown only here.")


class CodeIn(RequestModel):
    """The one-time code of the address that the terminal shows."""

    model_config = ConfigDict(json_schema_extra=_examples({"code": "q0Z1…"}))

    code: Annotated[str, Field(min_length=1, max_length=200)]


class CodeOut(AnswerModel):
    """What it stands for."""

    key: str = Field(description="An admin key; the code cannot be used again.")


class SkeletonJoint(AnswerModel):
    """One joint of a format."""

    name: str
    parent: int | None = Field(description="Index of its parent, null for a root or a graph.")
    forecast: Literal["net", "carried"] = Field(
        description="Forecast by the net, or carried with the nearest joint that is."
    )


class SkeletonOut(AnswerModel):
    """A format in which poses may come."""

    name: str
    root_relative: bool
    layout_sha256: str = Field(description="SHA-256 of the joint names, one per line.")
    joints: list[SkeletonJoint]
    bones: list[tuple[int, int]]


class SkeletonsOut(AnswerModel):
    """Every format."""

    items: list[SkeletonOut]


class LimitsOut(AnswerModel):
    """What a client may send at most."""

    max_message_bytes: int
    max_rate_hz: float
    idle_s: float
    streams_per_key: int
    streams_per_user: int
    forecast_frames: int
    trial_bytes: int
    clips: int
    frames_per_clip: int
    features: list[str] = Field(description="What this server can do.")


class FlagOut(AnswerModel):
    """One quality flag."""

    name: str
    severity: Severity
    meaning: str


class QualityOut(AnswerModel):
    """Every quality flag; one that you do not know counts as degraded."""

    items: list[FlagOut]


class HealthOut(AnswerModel):
    """A sign of life."""

    status: Literal["alive", "ready"]


class ReadyOut(HealthOut):
    """Ready to forecast. Hints only make news travel faster: without them, processes poll."""

    hints: Literal["off", "on", "away"] = Field(
        description="Hints from other processes through Redis; `off` where none is configured."
    )


class ClipOut(AnswerModel):
    """One clip of a trial."""

    ordinal: int
    action: str | None
    frames: int
    seconds: float
    used: bool = Field(description="Whether it is trained on.")
    reason: str | None = Field(description="Why it is not; null where it is.")
    message: str | None = Field(description="The same for people.")


class TrialOut(AnswerModel):
    """A recorded trial."""

    id: UUID
    user: str
    label: str | None
    state: TrialState
    source: TrialSource
    finetune: bool
    clips: int
    clips_unused: int = Field(description="Clips that are stored and not trained on.")
    frames: int
    seconds: float
    created_at: datetime
    stored_at: datetime | None
    details: list[ClipOut]


class JobOut(AnswerModel):
    """A fine-tuning job."""

    id: UUID
    user: str
    state: JobState
    reason: JobReason = Field(description="Why it is in its state.")
    message: str | None = Field(description="The end, or the last error, for people.")
    trials: list[UUID] | None = Field(
        description="What it trains on; null until it starts with all that is stored then."
    )
    requested_by: UUID | None
    attempt: int
    progress: dict[str, Any] | None
    created_at: datetime
    started_at: datetime | None
    finished_at: datetime | None
    version: int | None = Field(description="Number of the version that it made.")


class RecordedOut(AnswerModel):
    """A trial that was stored, and the job that will train on it."""

    trial: TrialOut
    job: JobOut | None


class VersionDetailOut(AnswerModel):
    """A version of a user's decoder."""

    number: int
    state: VersionState
    parent: int = Field(description="The version that was active when it was trained.")
    base_sha256: str
    sha256: str
    bytes: int
    purged: bool = Field(description="Whether its weights were removed.")
    trained_on: list[UUID]
    metrics: dict[str, Any]
    job: UUID | None
    created_at: datetime
    activated_at: datetime | None


class FinetuneIn(RequestModel):
    """What to train on."""

    model_config = ConfigDict(json_schema_extra=_examples({"trials": None}))

    trials: Annotated[list[UUID], Field(max_length=1000)] | None = Field(
        None, description="Exactly these; null is all that is stored when the job starts."
    )


class ActivationIn(RequestModel):
    """What the caller takes to be active."""

    model_config = ConfigDict(json_schema_extra=_examples({"active_sha256": "9f2c…"}))

    active_sha256: str | None = Field(
        None,
        max_length=64,
        description="Where something else is active by now, nothing changes (409).",
    )
