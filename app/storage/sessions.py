"""Stream sessions: a name of a user's stream, which only the newest stream holds.

Opening raises the epoch, in one transaction. A stream of an older epoch is fenced: it sees that at
its next ``watch`` and must close, and nothing that it still writes may be accepted.
"""

from collections.abc import Sequence
from uuid import UUID

from sqlalchemy import BigInteger, CompoundSelect, String, cast, delete, null, select, union_all
from sqlalchemy.exc import IntegrityError
from sqlalchemy.ext.asyncio import AsyncSession

from app.domain.errors import ForbiddenError, UserDeletedError
from app.domain.streams import OpenStream, Verdict
from app.storage.announcements import Topic, announce
from app.storage.database import Database
from app.storage.tables import KeyRow, SessionRow, UserRow, utc_now


async def open_session(
    database: Database, *, user_uuid: UUID, name: str, key_id: UUID, is_admin: bool
) -> int:
    """Take a name for a new stream and fence the one that had it; gives the new epoch.

    A name belongs to the key that opened it first. An admin may take it over, and does not keep
    it; a revoked key loses it to whoever comes next.

    Raises:
        ForbiddenError: the name belongs to another key that still works.
        UserDeletedError: the user was erased just now.
    """
    async with database.lock(f"session/{user_uuid}/{name}") as tx:
        row = await tx.get(SessionRow, (user_uuid, name))
        if row is None:
            await _add(tx, SessionRow(user_uuid=user_uuid, name=name, key_id=key_id, epoch=1))
            return 1
        if row.key_id != key_id and not is_admin:
            await _take_from_revoked(tx, row, key_id)
        row.epoch += 1
        row.opened_at = utc_now()
        announce(tx, Topic.STREAMS)  # of the stream that is fenced by this
        return row.epoch


async def discard_session(database: Database, *, user_uuid: UUID, name: str, epoch: int) -> None:
    """Forget a name that the server drew itself, when its stream ends and is still the newest."""
    async with database.write() as tx:
        await tx.execute(
            delete(SessionRow).where(
                SessionRow.user_uuid == user_uuid,
                SessionRow.name == name,
                SessionRow.epoch == epoch,
            )
        )


async def watch(database: Database, streams: Sequence[OpenStream]) -> dict[OpenStream, Verdict]:
    """Tell which open streams must close, and why, in one round trip.

    Raises:
        NotReadyError: the database cannot be reached; nobody is judged.
    """
    if not streams:
        return {}
    async with database.read() as tx:
        rows = (await tx.execute(_watch_query(streams))).all()
    alive = {uuid for uuid, name, _ in rows if name is None}
    epochs = {(uuid, name): epoch for uuid, name, epoch in rows if name is not None}
    verdicts = {stream: _judge(stream, alive=alive, epochs=epochs) for stream in streams}
    return {stream: verdict for stream, verdict in verdicts.items() if verdict is not None}


def _watch_query(streams: Sequence[OpenStream]) -> CompoundSelect[UUID, str | None, int]:
    """Ask for the users and keys that live, and for the newest epochs of the names."""
    users = {stream.user_uuid for stream in streams}
    names = {stream.session for stream in streams}
    keys = {stream.key_id for stream in streams}
    no_name, no_epoch = cast(null(), String), cast(0, BigInteger)
    return union_all(
        select(UserRow.uuid, no_name, no_epoch).where(UserRow.uuid.in_(users)),
        select(KeyRow.id, no_name, no_epoch).where(
            KeyRow.id.in_(keys), KeyRow.revoked_at.is_(None)
        ),
        select(SessionRow.user_uuid, SessionRow.name, SessionRow.epoch).where(
            SessionRow.user_uuid.in_(users), SessionRow.name.in_(names)
        ),
    )


def _judge(
    stream: OpenStream, *, alive: set[UUID], epochs: dict[tuple[UUID, str], int]
) -> Verdict | None:
    if stream.user_uuid not in alive:
        return Verdict.USER_DELETED
    if stream.key_id not in alive:
        return Verdict.KEY_REVOKED
    if epochs.get((stream.user_uuid, stream.session)) != stream.epoch:
        return Verdict.FENCED
    return None


async def _add(tx: AsyncSession, row: SessionRow) -> None:
    tx.add(row)
    try:
        await tx.flush()
    except IntegrityError:
        raise UserDeletedError("The user was erased just now.") from None


async def _take_from_revoked(tx: AsyncSession, row: SessionRow, key_id: UUID) -> None:
    owner = await tx.get(KeyRow, row.key_id)
    if owner is not None and owner.revoked_at is None:
        raise ForbiddenError("This session name belongs to another key.")
    row.key_id = key_id
