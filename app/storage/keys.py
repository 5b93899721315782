"""API keys: made, found by what a caller shows, listed, revoked."""

from contextlib import suppress
from datetime import datetime, timedelta
from uuid import UUID

from sqlalchemy import func, select, update
from sqlalchemy.ext.asyncio import AsyncSession

from app.domain.access import (
    BOOTSTRAP_KEY_ID,
    ApiKey,
    NewKey,
    Scope,
    find_key_id,
    hash_key,
    make_key,
    matches_key,
)
from app.domain.errors import NotReadyError, UnauthorizedError, UnknownKeyError
from app.domain.events import Action
from app.domain.pagination import Cursor, Page
from app.storage import audit
from app.storage.announcements import Topic, announce
from app.storage.database import Database
from app.storage.paging import page_query
from app.storage.tables import KeyRow, UserRow, utc_now

USED_EVERY = timedelta(hours=1)
"""How coarsely the last use is kept: a key that is used all the time costs one write an hour."""


async def create(
    tx: AsyncSession,
    *,
    scopes: frozenset[Scope],
    name: str | None,
    user_uuid: UUID | None,
    actor: UUID | None,
) -> NewKey:
    """Make a key; its text is in the result and nowhere else."""
    key = make_key()
    row = KeyRow(
        id=key.id, sha256=hash_key(key.text), name=name, scopes=scopes, user_uuid=user_uuid
    )
    tx.add(row)
    await tx.flush()
    audit.record(tx, Action.KEY_CREATED, actor=actor, user_uuid=user_uuid, key_id=key.id)
    return key


async def get(tx: AsyncSession, key_id: UUID) -> ApiKey:
    """Find a key by its id, revoked or not.

    Raises:
        UnknownKeyError: there is none.
    """
    found = (await tx.execute(_SELECT.where(KeyRow.id == key_id))).one_or_none()
    if found is None:
        raise UnknownKeyError(f"There is no key {key_id}.")
    return _to_key(found[0], found[1])


async def list_page(tx: AsyncSession, *, after: Cursor | None, limit: int) -> Page[ApiKey]:
    """List keys, newest first, the revoked ones too."""
    query = page_query(_SELECT, order=(KeyRow.created_at, KeyRow.id), after=after, limit=limit)
    rows = [(row, user) for row, user in await tx.execute(query)]
    last = rows[limit - 1][0] if len(rows) > limit else None
    return Page(
        items=[_to_key(row, user) for row, user in rows[:limit]],
        next_cursor=None if last is None else Cursor(last.created_at, last.id).encode(),
    )


async def list_all(tx: AsyncSession) -> list[ApiKey]:
    """List every key, newest first, the revoked ones too."""
    rows = await tx.execute(_SELECT.order_by(KeyRow.created_at.desc(), KeyRow.id))
    return [_to_key(row, user) for row, user in rows]


async def revoke(tx: AsyncSession, key_id: UUID, *, actor: UUID | None) -> None:
    """Stop a key from working; revoking it again changes nothing.

    Raises:
        UnknownKeyError: there is no such key.
    """
    row = await tx.get(KeyRow, key_id)
    if row is None:
        raise UnknownKeyError(f"There is no key {key_id}.")
    if row.revoked_at is not None:
        return
    row.revoked_at = utc_now()
    audit.record(tx, Action.KEY_REVOKED, actor=actor, user_uuid=row.user_uuid, key_id=key_id)
    announce(tx, Topic.STREAMS)


async def authenticate(database: Database, text: str) -> ApiKey:
    """Find the key that a caller shows.

    Raises:
        UnauthorizedError: there is no such key, or it was revoked.
        NotReadyError: the database cannot be reached.
    """
    async with database.read() as tx:
        found = await _match(tx, text)
    if found is None or found.revoked_at is not None:
        raise UnauthorizedError("The key is unknown or was revoked.")
    now = utc_now()
    if found.last_used_at is None or now - found.last_used_at > USED_EVERY:
        with suppress(NotReadyError):  # a busy database must not cost a request
            await _mark_used(database, found.id, now)
    return found


async def set_bootstrap(tx: AsyncSession, text: str | None) -> None:
    """Let exactly the admin key of the settings work: this one, or none."""
    row = await tx.get(KeyRow, BOOTSTRAP_KEY_ID)
    if text is None:
        if row is not None and row.revoked_at is None:
            row.revoked_at = utc_now()
        return
    if row is None:
        row = KeyRow(id=BOOTSTRAP_KEY_ID, name="KINECAST_ADMIN_KEY", sha256=b"")
        tx.add(row)
    row.scopes = frozenset({Scope.ADMIN})
    row.sha256, row.revoked_at = hash_key(text), None


async def count_admins(tx: AsyncSession) -> int:
    """Count the admin keys that work."""
    admin = KeyRow.scopes == frozenset({Scope.ADMIN})
    query = select(func.count()).where(admin, KeyRow.revoked_at.is_(None))
    return await tx.scalar(query) or 0


_SELECT = select(KeyRow, UserRow.id).outerjoin(UserRow, UserRow.uuid == KeyRow.user_uuid)


async def _match(tx: AsyncSession, text: str) -> ApiKey | None:
    ids = [BOOTSTRAP_KEY_ID, find_key_id(text) or BOOTSTRAP_KEY_ID]
    for row, user in await tx.execute(_SELECT.where(KeyRow.id.in_(ids))):
        if matches_key(text, row.sha256):
            return _to_key(row, user)
    return None


async def _mark_used(database: Database, key_id: UUID, now: datetime) -> None:
    async with database.write() as tx:
        await tx.execute(update(KeyRow).where(KeyRow.id == key_id).values(last_used_at=now))


def _to_key(row: KeyRow, user: str | None) -> ApiKey:
    return ApiKey(
        id=row.id,
        name=row.name,
        scopes=row.scopes,
        user=user,
        created_at=row.created_at,
        revoked_at=row.revoked_at,
        last_used_at=row.last_used_at,
    )
