"""Users: the row that everything else of a person hangs on."""

import math
from collections.abc import Mapping
from typing import Any
from uuid import UUID

from sqlalchemy import delete, select, update
from sqlalchemy.exc import IntegrityError
from sqlalchemy.ext.asyncio import AsyncSession

from app.domain.errors import UnknownUserError, UserExistsError
from app.domain.events import Action
from app.domain.pagination import Cursor, Page
from app.domain.users import Lived, UpAxis, User, may_be_user_id, pseudonym
from app.storage import audit, weights
from app.storage.announcements import Topic, announce
from app.storage.paging import page_query
from app.storage.tables import UserRow

CHANGEABLE = frozenset({"display_name", "auto_promote"})


async def create(
    tx: AsyncSession,
    *,
    user_id: str,
    skeleton: str,
    up: UpAxis,
    root_relative: bool,
    display_name: str | None,
    actor: UUID | None,
) -> User:
    """Add a user.

    Raises:
        UserExistsError: the id is taken.
    """
    row = UserRow(
        id=user_id,
        skeleton=skeleton,
        up=up,
        root_relative=root_relative,
        display_name=display_name,
    )
    tx.add(row)
    try:
        await tx.flush()
    except IntegrityError:
        raise UserExistsError(f"There is a user {user_id} already.") from None
    audit.record(tx, Action.USER_CREATED, actor=actor, user_uuid=row.uuid)
    return _to_user(row)


async def get(tx: AsyncSession, user_id: str) -> User:
    """Find a user by id.

    Raises:
        UnknownUserError: there is none.
    """
    return _to_user(await _find(tx, user_id))


async def get_by_uuid(tx: AsyncSession, user_uuid: UUID) -> User:
    """Find a user by what their rows hang on.

    Raises:
        UnknownUserError: they were erased.
    """
    row = await tx.get(UserRow, user_uuid)
    if row is None:
        raise UnknownUserError("The user was erased just now.")
    return _to_user(row)


async def list_page(tx: AsyncSession, *, after: Cursor | None, limit: int) -> Page[User]:
    """List users, newest first."""
    query = page_query(
        select(UserRow), order=(UserRow.created_at, UserRow.uuid), after=after, limit=limit
    )
    rows = list(await tx.scalars(query))
    last = rows[limit - 1] if len(rows) > limit else None
    return Page(
        items=[_to_user(row) for row in rows[:limit]],
        next_cursor=None if last is None else Cursor(last.created_at, last.uuid).encode(),
    )


async def change(
    tx: AsyncSession, user_id: str, changes: Mapping[str, Any], *, actor: UUID | None
) -> User:
    """Change the name that people see, or whether versions become active by themselves.

    Args:
        tx: a transaction for writing.
        user_id: whose.
        changes: new values of `display_name` and `auto_promote`, as far as they change.
        actor: the key that asks.

    Raises:
        UnknownUserError: there is no such user.
    """
    if not changes.keys() <= CHANGEABLE:
        raise ValueError(f"of a user only {sorted(CHANGEABLE)} may change")
    _require_possible(user_id)
    row = await tx.scalar(
        update(UserRow).where(UserRow.id == user_id).values(**changes).returning(UserRow)
    )
    if row is None:
        raise UnknownUserError(f"There is no user {user_id}.")
    audit.record(tx, Action.USER_CHANGED, actor=actor, user_uuid=row.uuid)
    return _to_user(row)


async def erase(tx: AsyncSession, user_id: str, *, actor: UUID | None, audit_key: bytes) -> None:
    """Delete a user and every row of theirs; of the id, only a pseudonym stays in the log.

    Raises:
        UnknownUserError: there is no such user.
    """
    _require_possible(user_id)
    gone = await tx.scalar(
        delete(UserRow).where(UserRow.id == user_id).returning(UserRow.uuid)
    )  # the rows that hang on it go by the foreign keys
    if gone is None:
        raise UnknownUserError(f"There is no user {user_id}.")
    await weights.drop_unused(tx)
    subject = pseudonym(user_id, key=audit_key)
    audit.record(tx, Action.USER_DELETED, actor=actor, subject=subject)
    announce(tx, Topic.STREAMS)


async def note_lived(tx: AsyncSession, user_uuid: UUID, newer: Lived) -> None:
    """Blend what was seen on a stream into what is known; of an erased user nothing is kept."""
    await note_all_lived(tx, {user_uuid: newer})


async def note_all_lived(tx: AsyncSession, newer: Mapping[UUID, Lived]) -> None:
    """Blend what was seen of several users into what is known of each; as `note_lived`.

    What is not finite is no body, and neither can it be stored.
    """
    seen = {
        user: lived
        for user, lived in newer.items()
        if all(map(math.isfinite, (*lived.bones, lived.seconds)))
    }
    rows = await tx.scalars(
        select(UserRow)
        .where(UserRow.uuid.in_(seen))
        .order_by(UserRow.created_at, UserRow.uuid)  # as whoever else locks many of them
        .with_for_update(key_share=True)
    )
    for row in rows:
        known = _to_lived(row)
        joined = seen[row.uuid] if known is None else known.join(seen[row.uuid])
        row.lived_bones, row.lived_s = list(joined.bones), joined.seconds


async def read_lived(tx: AsyncSession, user_uuid: UUID) -> Lived | None:
    """Tell whose body was seen on a user's streams, None if nobody's was."""
    row = await tx.get(UserRow, user_uuid)
    return None if row is None else _to_lived(row)


def _to_lived(row: UserRow) -> Lived | None:
    return None if row.lived_bones is None else Lived(tuple(row.lived_bones), row.lived_s)


def _require_possible(user_id: str) -> None:
    """Refuse what cannot be an id before a database is asked."""
    if not may_be_user_id(user_id):
        raise UnknownUserError("There is no such user.")


async def _find(tx: AsyncSession, user_id: str) -> UserRow:
    _require_possible(user_id)
    row = await tx.scalar(select(UserRow).where(UserRow.id == user_id))
    if row is None:
        raise UnknownUserError(f"There is no user {user_id}.")
    return row


def _to_user(row: UserRow) -> User:
    return User(
        uuid=row.uuid,
        id=row.id,
        skeleton=row.skeleton,
        up=_UP[row.up],
        root_relative=row.root_relative,
        display_name=row.display_name,
        created_at=row.created_at,
        auto_promote=row.auto_promote,
    )


_UP: dict[str, UpAxis] = {"y": "y", "-y": "-y", "z": "z"}
