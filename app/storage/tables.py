"""The tables. Every constraint has a name, so that every database can change it later."""

import math
from datetime import UTC, datetime
from typing import Any, ClassVar
from uuid import UUID, uuid4

from sqlalchemy import (
    JSON,
    BigInteger,
    CheckConstraint,
    DateTime,
    Dialect,
    ForeignKey,
    ForeignKeyConstraint,
    Index,
    Integer,
    LargeBinary,
    MetaData,
    String,
    Text,
    TypeDecorator,
    text,
    true,
)
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column

from app.domain.access import Scope

NAMES = {
    "ix": "ix_%(table_name)s_%(column_0_N_name)s",
    "uq": "uq_%(table_name)s_%(column_0_N_name)s",
    "ck": "ck_%(table_name)s_%(constraint_name)s",
    "fk": "fk_%(table_name)s_%(column_0_N_name)s",
    "pk": "pk_%(table_name)s",
}


class Instant(TypeDecorator[datetime]):
    """A moment in UTC: with a zone in PostgreSQL, as sortable text in SQLite, aware in Python."""

    impl = DateTime(timezone=True)
    cache_ok = True

    def process_bind_param(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        """Refuse moments without a zone, and store the rest in UTC."""
        if value is None:
            return None
        if value.tzinfo is None:
            raise ValueError("an instant needs a time zone")
        moment = value.astimezone(UTC)
        return moment.replace(tzinfo=None) if dialect.name == "sqlite" else moment

    def process_result_value(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        """Give the moment back in UTC."""
        if value is None:
            return None
        return value.replace(tzinfo=UTC) if dialect.name == "sqlite" else value.astimezone(UTC)


class Scopes(TypeDecorator[frozenset[Scope]]):
    """A set of scopes, as their names in order, joined by commas."""

    impl = String(64)
    cache_ok = True

    def process_bind_param(self, value: frozenset[Scope] | None, dialect: Dialect) -> str | None:
        """Write the names."""
        del dialect
        return None if value is None else ",".join(sorted(value))

    def process_result_value(self, value: str | None, dialect: Dialect) -> frozenset[Scope] | None:
        """Read the names."""
        del dialect
        return None if value is None else frozenset(Scope(name) for name in value.split(","))


class Figures(TypeDecorator[dict[str, Any]]):
    """What the nets or their judge have to say, as JSON, which knows no NaN and no infinity.

    PostgreSQL refuses them, and SQLite would keep what no client can read.
    """

    impl = JSON(none_as_null=True)
    cache_ok = True

    def process_bind_param(
        self, value: dict[str, Any] | None, dialect: Dialect
    ) -> dict[str, Any] | None:
        """Write none where a number is not finite."""
        del dialect
        return None if value is None else {name: keep_finite(one) for name, one in value.items()}


def keep_finite(value: object) -> object:
    """Replace numbers that are not finite by None, however deep they are."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {name: keep_finite(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [keep_finite(one) for one in value]
    return value


def utc_now() -> datetime:
    """Give the moment, in UTC."""
    return datetime.now(UTC)


class Base(DeclarativeBase):
    """Root of all tables."""

    metadata = MetaData(naming_convention=NAMES)
    type_annotation_map: ClassVar[dict[Any, Any]] = {
        datetime: Instant,
        frozenset[Scope]: Scopes,
        dict[str, Any]: Figures,
        list[str]: JSON(none_as_null=True),
        list[float]: JSON(none_as_null=True),
    }


class UserRow(Base):
    """A person. Everything of theirs hangs on ``uuid`` and goes with it."""

    __tablename__ = "users"
    __table_args__ = (
        CheckConstraint("up IN ('y', '-y', 'z')", name="up"),
        Index(None, "created_at", "uuid"),
    )

    uuid: Mapped[UUID] = mapped_column(primary_key=True, default=uuid4)
    id: Mapped[str] = mapped_column(String(64), unique=True)
    skeleton: Mapped[str] = mapped_column(String(64))
    up: Mapped[str] = mapped_column(String(2))
    root_relative: Mapped[bool]
    display_name: Mapped[str | None] = mapped_column(String(200))
    created_at: Mapped[datetime] = mapped_column(default=utc_now)
    auto_promote: Mapped[bool] = mapped_column(default=True, server_default=true())
    last_version: Mapped[int] = mapped_column(default=0, server_default=text("0"))
    served_at: Mapped[datetime | None]
    refitted_for: Mapped[str | None] = mapped_column(String(64))
    lived_bones: Mapped[list[float] | None]
    lived_s: Mapped[float] = mapped_column(default=0.0, server_default=text("0"))


class KeyRow(Base):
    """An API key, as the hash of its text."""

    __tablename__ = "api_keys"
    __table_args__ = (Index(None, "created_at", "id"),)

    id: Mapped[UUID] = mapped_column(primary_key=True)
    sha256: Mapped[bytes] = mapped_column(LargeBinary(32))
    name: Mapped[str | None] = mapped_column(String(200))
    scopes: Mapped[frozenset[Scope]]
    user_uuid: Mapped[UUID | None] = mapped_column(
        ForeignKey("users.uuid", ondelete="CASCADE"), index=True
    )
    created_at: Mapped[datetime] = mapped_column(default=utc_now)
    revoked_at: Mapped[datetime | None]
    last_used_at: Mapped[datetime | None]


class SessionRow(Base):
    """A name under which streams of a user are opened, one at a time."""

    __tablename__ = "stream_sessions"
    __table_args__ = (CheckConstraint("epoch >= 1", name="epoch"),)

    user_uuid: Mapped[UUID] = mapped_column(
        ForeignKey("users.uuid", ondelete="CASCADE"), primary_key=True
    )
    name: Mapped[str] = mapped_column(String(64), primary_key=True)
    epoch: Mapped[int] = mapped_column(BigInteger)
    key_id: Mapped[UUID] = mapped_column(ForeignKey("api_keys.id", ondelete="CASCADE"), index=True)
    opened_at: Mapped[datetime] = mapped_column(default=utc_now)


class AuditRow(Base):
    """Who did what, and when. Of an erased user only a pseudonym stays, in ``subject``."""

    __tablename__ = "audit"

    id: Mapped[int] = mapped_column(
        BigInteger().with_variant(Integer, "sqlite"), primary_key=True, autoincrement=True
    )
    at: Mapped[datetime] = mapped_column(default=utc_now)
    action: Mapped[str] = mapped_column(String(32))
    actor: Mapped[UUID | None]
    key_id: Mapped[UUID | None]
    user_uuid: Mapped[UUID | None] = mapped_column(
        ForeignKey("users.uuid", ondelete="CASCADE"), index=True
    )
    subject: Mapped[str | None] = mapped_column(String(64))


def _owner(*, index: bool = False) -> Any:  # noqa: ANN401 - as Mapped wants it
    """Hang a row on its user, with whom it goes."""
    return mapped_column(ForeignKey("users.uuid", ondelete="CASCADE"), index=index)


class TrialRow(Base):
    """What a person was recorded doing. A recording belongs to the newest epoch of its session."""

    __tablename__ = "trials"
    __table_args__ = (
        Index(None, "user_uuid", "created_at", "id"),
        Index(
            "ix_trials_recording",
            "touched_at",
            sqlite_where=text("state = 'recording'"),
            postgresql_where=text("state = 'recording'"),
        ),
    )

    id: Mapped[UUID] = mapped_column(primary_key=True, default=uuid4)
    user_uuid: Mapped[UUID] = _owner()
    label: Mapped[str | None] = mapped_column(String(200))
    state: Mapped[str] = mapped_column(String(16))
    source: Mapped[str] = mapped_column(String(16))
    finetune: Mapped[bool]
    session: Mapped[str | None] = mapped_column(String(64))
    epoch: Mapped[int | None] = mapped_column(BigInteger)
    stored_seq: Mapped[int | None] = mapped_column(BigInteger)
    created_at: Mapped[datetime] = mapped_column(default=utc_now)
    touched_at: Mapped[datetime] = mapped_column(default=utc_now)
    stored_at: Mapped[datetime | None]


class ClipRow(Base):
    """One clip of a trial: what is known of it without its frames."""

    __tablename__ = "clips"

    trial_id: Mapped[UUID] = mapped_column(
        ForeignKey("trials.id", ondelete="CASCADE"), primary_key=True
    )
    ordinal: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    action: Mapped[str | None] = mapped_column(String(200))
    frames: Mapped[int]
    seconds: Mapped[float]
    flaw: Mapped[str | None] = mapped_column(String(32))


class ChunkRow(Base):
    """Some frames of a clip, packed; kept apart, so that listing clips reads no frames."""

    __tablename__ = "chunks"
    __table_args__ = (
        ForeignKeyConstraint(
            ["trial_id", "clip"], ["clips.trial_id", "clips.ordinal"], ondelete="CASCADE"
        ),
    )

    trial_id: Mapped[UUID] = mapped_column(primary_key=True)
    clip: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    ordinal: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    frames: Mapped[int]
    payload: Mapped[bytes] = mapped_column(LargeBinary)


class JobRow(Base):
    """A fine-tuning job. Per user one runs, and one of each kind waits."""

    __tablename__ = "jobs"
    __table_args__ = (
        Index(
            "uq_jobs_queued",
            "user_uuid",
            "explicit",
            unique=True,
            sqlite_where=text("state = 'queued'"),
            postgresql_where=text("state = 'queued'"),
        ),
        Index(
            "uq_jobs_running",
            "user_uuid",
            unique=True,
            sqlite_where=text("state = 'running'"),
            postgresql_where=text("state = 'running'"),
        ),
        Index(None, "created_at", "id"),
        Index(None, "user_uuid", "created_at", "id"),
        Index(None, "user_uuid", "finished_at"),
        Index(None, "state", "lease_until"),
    )

    id: Mapped[UUID] = mapped_column(primary_key=True, default=uuid4)
    user_uuid: Mapped[UUID] = _owner()
    state: Mapped[str] = mapped_column(String(16))
    reason: Mapped[str] = mapped_column(String(32))
    explicit: Mapped[bool]
    trials: Mapped[list[str] | None]
    requested_by: Mapped[UUID | None]
    attempt: Mapped[int] = mapped_column(default=0)
    fence: Mapped[int] = mapped_column(BigInteger, default=0)
    lease_owner: Mapped[str | None] = mapped_column(String(128))
    lease_until: Mapped[datetime | None]
    cancelling: Mapped[bool] = mapped_column(default=False)
    progress: Mapped[dict[str, Any] | None]
    message: Mapped[str | None] = mapped_column(Text)
    created_at: Mapped[datetime] = mapped_column(default=utc_now)
    started_at: Mapped[datetime | None]
    finished_at: Mapped[datetime | None]
    version: Mapped[int | None]
    base_sha256: Mapped[str | None] = mapped_column(String(64))


class WeightsRow(Base):
    """Weights, named by their digest; never changed. Bases are rows too."""

    __tablename__ = "weights"

    sha256: Mapped[str] = mapped_column(String(64), primary_key=True)
    kind: Mapped[str] = mapped_column(String(16))
    size: Mapped[int]
    blob: Mapped[bytes] = mapped_column(LargeBinary)
    created_at: Mapped[datetime] = mapped_column(default=utc_now)


class VersionRow(Base):
    """A version of a user's decoder. Its weights may be purged; the row stays."""

    __tablename__ = "versions"
    __table_args__ = (
        Index(None, "user_uuid", "number", unique=True),
        Index(
            "uq_versions_active",
            "user_uuid",
            unique=True,
            sqlite_where=text("state = 'active'"),
            postgresql_where=text("state = 'active'"),
        ),
        Index(None, "user_uuid", "created_at", "id"),
        CheckConstraint("number >= 1", name="number"),
    )

    id: Mapped[UUID] = mapped_column(primary_key=True, default=uuid4)
    user_uuid: Mapped[UUID] = _owner()
    number: Mapped[int]
    state: Mapped[str] = mapped_column(String(16))
    parent: Mapped[int]
    base_sha256: Mapped[str] = mapped_column(String(64))
    sha256: Mapped[str] = mapped_column(String(64))
    size: Mapped[int]
    weights_sha256: Mapped[str | None] = mapped_column(ForeignKey("weights.sha256"), index=True)
    trained_on: Mapped[list[str]]
    metrics: Mapped[dict[str, Any]]
    job_id: Mapped[UUID | None] = mapped_column(ForeignKey("jobs.id", ondelete="SET NULL"))
    created_at: Mapped[datetime] = mapped_column(default=utc_now)
    activated_at: Mapped[datetime | None]


class ActivationRow(Base):
    """What was made active, when and by whom; only ever added to."""

    __tablename__ = "activations"

    id: Mapped[int] = mapped_column(
        BigInteger().with_variant(Integer, "sqlite"), primary_key=True, autoincrement=True
    )
    user_uuid: Mapped[UUID] = _owner(index=True)
    number: Mapped[int]
    kind: Mapped[str] = mapped_column(String(16))
    actor: Mapped[UUID | None]
    at: Mapped[datetime] = mapped_column(default=utc_now)


class IdempotencyRow(Base):
    """The answer to a request that may come again, per key, route and user."""

    __tablename__ = "idempotency"

    key_id: Mapped[UUID] = mapped_column(
        ForeignKey("api_keys.id", ondelete="CASCADE"), primary_key=True
    )
    user_uuid: Mapped[UUID] = mapped_column(
        ForeignKey("users.uuid", ondelete="CASCADE"), primary_key=True, index=True
    )
    route: Mapped[str] = mapped_column(String(64), primary_key=True)
    token: Mapped[str] = mapped_column(String(200), primary_key=True)
    body_sha256: Mapped[str] = mapped_column(String(64))
    status: Mapped[int]
    answer: Mapped[bytes] = mapped_column(LargeBinary)
    expires_at: Mapped[datetime] = mapped_column(index=True)
