"""The tables. Every constraint has a name, so that every database can change it later."""

from datetime import UTC, datetime
from typing import Any, ClassVar
from uuid import UUID, uuid4

from sqlalchemy import (
    BigInteger,
    CheckConstraint,
    DateTime,
    Dialect,
    ForeignKey,
    Index,
    Integer,
    LargeBinary,
    MetaData,
    String,
    TypeDecorator,
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


def utc_now() -> datetime:
    """Give the moment, in UTC."""
    return datetime.now(UTC)


class Base(DeclarativeBase):
    """Root of all tables."""

    metadata = MetaData(naming_convention=NAMES)
    type_annotation_map: ClassVar[dict[Any, Any]] = {
        datetime: Instant,
        frozenset[Scope]: Scopes,
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
