"""Versions of a user's decoder: added with what they did, activated, rolled back, purged.

Whatever changes which version is active first locks the user's row, so that two who decide at once
decide one after the other.
"""

from collections.abc import Collection
from dataclasses import dataclass
from datetime import datetime
from typing import Any
from uuid import UUID

from sqlalchemy import select, update
from sqlalchemy.ext.asyncio import AsyncSession

from app.domain.errors import (
    ActiveChangedError,
    UnknownUserError,
    UnknownVersionError,
    WeightsPurgedError,
)
from app.domain.events import Action
from app.domain.pagination import Cursor, Page
from app.domain.versions import (
    BASE_NUMBER,
    Activation,
    ActivationKind,
    ActiveVersion,
    Standing,
    Version,
    VersionState,
    find_rollback,
    list_purgeable,
)
from app.storage import audit, weights
from app.storage.announcements import Topic, announce
from app.storage.paging import page_query
from app.storage.tables import ActivationRow, UserRow, VersionRow, utc_now


@dataclass(frozen=True, slots=True)
class NewVersion:
    """A version to be stored.

    Attributes:
        blob: its weights.
        parent: the version that was active when it was trained, 0 for the base.
        base_sha256: the base that it runs on.
        trained_on: the trials.
        metrics: the judge's figures.
        job_id: the job that made it, None if none did.
        state: candidate or rejected.
    """

    blob: bytes
    parent: int
    base_sha256: str
    trained_on: tuple[UUID, ...]
    metrics: dict[str, Any]
    job_id: UUID | None
    state: VersionState


@dataclass(frozen=True, slots=True)
class HistoryLine:
    """One line of the history of what was active, as it is exported."""

    at: datetime
    number: int
    kind: ActivationKind
    actor: UUID | None


async def get(tx: AsyncSession, user_uuid: UUID, number: int) -> Version:
    """Find a version of a user.

    Raises:
        UnknownVersionError: this user never had it.
    """
    return _to_version(await _find(tx, user_uuid, number))


async def list_page(
    tx: AsyncSession, user_uuid: UUID, *, after: Cursor | None, limit: int
) -> Page[Version]:
    """List a user's versions, newest first."""
    query = page_query(
        select(VersionRow).where(VersionRow.user_uuid == user_uuid),
        order=(VersionRow.created_at, VersionRow.id),
        after=after,
        limit=limit,
    )
    rows = list(await tx.scalars(query))
    last = rows[limit - 1] if len(rows) > limit else None
    return Page(
        items=[_to_version(row) for row in rows[:limit]],
        next_cursor=None if last is None else Cursor(last.created_at, last.id).encode(),
    )


async def list_all(tx: AsyncSession, user_uuid: UUID) -> list[Version]:
    """List all of a user's versions, oldest first."""
    query = select(VersionRow).where(VersionRow.user_uuid == user_uuid).order_by(VersionRow.number)
    return [_to_version(row) for row in await tx.scalars(query)]


async def read_active(tx: AsyncSession, user_uuids: Collection[UUID]) -> dict[UUID, ActiveVersion]:
    """Tell what is active, for many users in one round trip; whoever is not in it has the base."""
    query = select(
        VersionRow.user_uuid, VersionRow.number, VersionRow.sha256, VersionRow.base_sha256
    ).where(VersionRow.user_uuid.in_(user_uuids), VersionRow.state == VersionState.ACTIVE)
    return {
        user: ActiveVersion(number, sha256, base)
        for user, number, sha256, base in await tx.execute(query)
    }


async def read_active_of(tx: AsyncSession, user_uuid: UUID) -> ActiveVersion:
    """Tell what is active for one user."""
    return (await read_active(tx, [user_uuid])).get(user_uuid, ActiveVersion())


async def read_previous(tx: AsyncSession, user_uuid: UUID) -> ActiveVersion:
    """Tell what a rollback would lead to: the next step down where the active one fails."""
    number = await _find_rollback(tx, user_uuid)
    if number == BASE_NUMBER:
        return ActiveVersion()
    row = await _find(tx, user_uuid, number)
    return ActiveVersion(row.number, row.sha256, row.base_sha256)


async def add(tx: AsyncSession, user_uuid: UUID, new: NewVersion) -> Version:
    """Store a version with its weights, under the user's next number."""
    number = await tx.scalar(
        update(UserRow)
        .where(UserRow.uuid == user_uuid)
        .values(last_version=UserRow.last_version + 1)
        .returning(UserRow.last_version)
        .execution_options(synchronize_session=False)
    )
    if number is None:
        raise UnknownUserError("The user was erased just now.")
    sha256 = await weights.put(tx, new.blob, kind="personal")
    row = VersionRow(
        user_uuid=user_uuid,
        number=number,
        state=new.state,
        parent=new.parent,
        base_sha256=new.base_sha256,
        sha256=sha256,
        size=len(new.blob),
        weights_sha256=sha256,
        trained_on=[str(trial) for trial in new.trained_on],
        metrics=new.metrics,
        job_id=new.job_id,
    )
    tx.add(row)
    await tx.flush()
    return _to_version(row)


async def read_standing(tx: AsyncSession, user_uuid: UUID) -> Standing:
    """Give what decides whether a candidate becomes active by itself; locks the user.

    Raises:
        UnknownUserError: they were erased.
    """
    user = await lock_user(tx, user_uuid)
    active = await read_active_of(tx, user_uuid)
    taken_back = await _list_rolled_back(tx, user_uuid)
    digests = await tx.scalars(
        select(VersionRow.sha256).where(
            VersionRow.user_uuid == user_uuid, VersionRow.number.in_(taken_back)
        )
    )
    return Standing(
        auto_promote=user.auto_promote, active=active.number, rolled_back=frozenset(digests)
    )


async def activate(
    tx: AsyncSession, user_uuid: UUID, number: int, *, kind: ActivationKind, actor: UUID | None
) -> None:
    """Let a version answer from now on, 0 for the base. The caller has locked the user.

    One that is active already stays so, without a line in the history: a rollback must lead to
    another one.

    Raises:
        UnknownVersionError: this user never had it.
        WeightsPurgedError: it has no weights any more.
    """
    target = None if number == BASE_NUMBER else await _find(tx, user_uuid, number)
    if target is not None and target.weights_sha256 is None:
        raise WeightsPurgedError(f"The weights of version {number} were removed.")
    is_rollback = kind is ActivationKind.ROLLED_BACK
    if not is_rollback and (await read_active_of(tx, user_uuid)).number == number:
        return
    await tx.execute(
        update(VersionRow)
        .where(VersionRow.user_uuid == user_uuid, VersionRow.state == VersionState.ACTIVE)
        .values(state=VersionState.RETIRED)
    )
    if target is not None:
        target.state, target.activated_at = VersionState.ACTIVE, utc_now()
    tx.add(ActivationRow(user_uuid=user_uuid, number=number, kind=kind, actor=actor))
    await tx.flush()
    announce(tx, Topic.STREAMS)


async def promote(
    tx: AsyncSession,
    user_uuid: UUID,
    number: int,
    *,
    expected: str | None,
    base_sha256: str,
    actor: UUID | None,
) -> None:
    """Activate a version by hand; from then on versions are promoted by hand only.

    Args:
        tx: a transaction for writing.
        user_uuid: whose.
        number: which, 0 for the base.
        expected: sha256 of what the caller takes to be active, None if they did not look.
        base_sha256: what the base is called.
        actor: the key that asks.

    Raises:
        ActiveChangedError: something else is active than expected.
        UnknownVersionError, WeightsPurgedError: as `activate`.
    """
    await _prepare_by_hand(tx, user_uuid, expected=expected, base_sha256=base_sha256)
    await activate(tx, user_uuid, number, kind=ActivationKind.BY_HAND, actor=actor)
    audit.record(tx, Action.VERSION_PROMOTED, actor=actor, user_uuid=user_uuid)


async def roll_back(
    tx: AsyncSession,
    user_uuid: UUID,
    *,
    expected: str | None,
    base_sha256: str,
    actor: UUID | None,
) -> int:
    """Go back to what was active before; gives its number. Arguments as of `promote`.

    Raises:
        ActiveChangedError: something else is active than expected.
    """
    await _prepare_by_hand(tx, user_uuid, expected=expected, base_sha256=base_sha256)
    number = await _find_rollback(tx, user_uuid)
    await activate(tx, user_uuid, number, kind=ActivationKind.ROLLED_BACK, actor=actor)
    audit.record(tx, Action.VERSION_ROLLED_BACK, actor=actor, user_uuid=user_uuid)
    return number


async def purge(tx: AsyncSession, user_uuid: UUID, *, keep: int) -> list[int]:
    """Remove the weights of old versions; their figures stay. The caller has locked the user."""
    every = await list_all(tx, user_uuid)
    active = next((v.number for v in every if v.state is VersionState.ACTIVE), BASE_NUMBER)
    gone = list_purgeable(every, active=active, keep=keep)
    if gone:
        await tx.execute(
            update(VersionRow)
            .where(VersionRow.user_uuid == user_uuid, VersionRow.number.in_(gone))
            .values(weights_sha256=None)
        )
        await weights.drop_unused(tx)
    return gone


async def list_history(tx: AsyncSession, user_uuid: UUID) -> list[HistoryLine]:
    """List everything that was ever active, oldest first."""
    query = (
        select(ActivationRow).where(ActivationRow.user_uuid == user_uuid).order_by(ActivationRow.id)
    )
    return [
        HistoryLine(row.at, row.number, ActivationKind(row.kind), row.actor)
        for row in await tx.scalars(query)
    ]


async def list_trials(tx: AsyncSession, user_uuid: UUID, number: int) -> list[str]:
    """List the trials that a version was trained on, by their ids; none for the base."""
    query = select(VersionRow.trained_on).where(
        VersionRow.user_uuid == user_uuid, VersionRow.number == number
    )
    return [str(trial) for trial in await tx.scalar(query) or []]


async def lock_user(tx: AsyncSession, user_uuid: UUID) -> UserRow:
    """Let nobody else decide about this user until the transaction ends.

    Raises:
        UnknownUserError: they were erased.
    """
    row = await tx.scalar(
        select(UserRow)
        .where(UserRow.uuid == user_uuid)
        .with_for_update(key_share=True)
        .execution_options(populate_existing=True)
    )
    if row is None:
        raise UnknownUserError("The user was erased just now.")
    return row


async def _prepare_by_hand(
    tx: AsyncSession, user_uuid: UUID, *, expected: str | None, base_sha256: str
) -> None:
    """Lock the user, compare what is active with what the caller expects, and take over."""
    user = await lock_user(tx, user_uuid)
    active = await read_active_of(tx, user_uuid)
    found = active.sha256 or base_sha256
    if expected is not None and expected != found:
        raise ActiveChangedError(f"Version {active.number} ({found}) is active now.")
    user.auto_promote = False


async def _find_rollback(tx: AsyncSession, user_uuid: UUID) -> int:
    history = [Activation(line.number, line.kind) for line in await list_history(tx, user_uuid)]
    usable = {BASE_NUMBER} | set(
        await tx.scalars(
            select(VersionRow.number).where(
                VersionRow.user_uuid == user_uuid, VersionRow.weights_sha256.is_not(None)
            )
        )
    )
    return find_rollback(history, usable=usable.__contains__)


async def _list_rolled_back(tx: AsyncSession, user_uuid: UUID) -> set[int]:
    """List the versions that a rollback took back, whatever became of them later."""
    taken: set[int] = set()
    active = BASE_NUMBER
    for line in await list_history(tx, user_uuid):
        if line.kind is ActivationKind.ROLLED_BACK:
            taken.add(active)
        active = line.number
    return taken - {BASE_NUMBER}


async def _find(tx: AsyncSession, user_uuid: UUID, number: int) -> VersionRow:
    row = await tx.scalar(
        select(VersionRow).where(VersionRow.user_uuid == user_uuid, VersionRow.number == number)
    )
    if row is None:
        raise UnknownVersionError(f"There is no version {number}.")
    return row


def _to_version(row: VersionRow) -> Version:
    return Version(
        number=row.number,
        state=VersionState(row.state),
        parent=row.parent,
        base_sha256=row.base_sha256,
        sha256=row.sha256,
        size=row.size,
        purged=row.weights_sha256 is None,
        trained_on=tuple(UUID(trial) for trial in row.trained_on),
        metrics=row.metrics,
        job_id=row.job_id,
        created_at=row.created_at,
        activated_at=row.activated_at,
    )
