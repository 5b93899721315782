"""Trials and their clips: stored whole, listed without their frames, erased."""

from collections.abc import AsyncIterator, Sequence
from dataclasses import dataclass
from uuid import UUID

from sqlalchemy import delete, select, update
from sqlalchemy.ext.asyncio import AsyncSession

from app.domain.errors import TrialConflictError, UnknownTrialError
from app.domain.events import Action
from app.domain.pagination import Cursor, Page
from app.domain.trials import ClipFlaw, ClipInfo, Trial, TrialSource, TrialState
from app.domain.users import User
from app.storage import audit
from app.storage.paging import page_query
from app.storage.tables import ChunkRow, ClipRow, TrialRow, utc_now


@dataclass(frozen=True, slots=True)
class NewClip:
    """A clip to be stored.

    Attributes:
        info: what is known of it; `ordinal` counts from 0.
        payload: its frames, packed.
    """

    info: ClipInfo
    payload: bytes


@dataclass(frozen=True, slots=True)
class StoredClip:
    """A clip with its packed frames, in chunks."""

    trial_id: UUID
    info: ClipInfo
    chunks: tuple[bytes, ...]


async def add(
    tx: AsyncSession, user: User, *, label: str | None, finetune: bool, clips: Sequence[NewClip]
) -> Trial:
    """Store a whole trial at once, as it was uploaded."""
    now = utc_now()
    row = TrialRow(
        user_uuid=user.uuid,
        label=label,
        state=TrialState.STORED,
        source=TrialSource.UPLOAD,
        finetune=finetune,
        created_at=now,
        touched_at=now,
        stored_at=now,
    )
    tx.add(row)
    await tx.flush()
    for clip in clips:
        tx.add(_to_clip_row(row.id, clip.info))
    await tx.flush()
    for clip in clips:
        tx.add(
            ChunkRow(
                trial_id=row.id,
                clip=clip.info.ordinal,
                ordinal=0,
                frames=clip.info.frames,
                payload=clip.payload,
            )
        )
    await tx.flush()
    return _to_trial(row, user.id, [clip.info for clip in clips])


async def get(tx: AsyncSession, user: User, trial_id: UUID) -> Trial:
    """Find a trial of a user.

    Raises:
        UnknownTrialError: this user has none of that id.
    """
    row = await tx.scalar(
        select(TrialRow).where(TrialRow.id == trial_id, TrialRow.user_uuid == user.uuid)
    )
    if row is None:
        raise UnknownTrialError(f"There is no trial {trial_id}.")
    clips = await _list_clips(tx, [row.id])
    return _to_trial(row, user.id, clips.get(row.id, []))


async def list_page(
    tx: AsyncSession, user: User, *, after: Cursor | None, limit: int
) -> Page[Trial]:
    """List a user's trials, newest first, the cancelled ones too."""
    query = page_query(
        select(TrialRow).where(TrialRow.user_uuid == user.uuid),
        order=(TrialRow.created_at, TrialRow.id),
        after=after,
        limit=limit,
    )
    rows = list(await tx.scalars(query))
    last = rows[limit - 1] if len(rows) > limit else None
    clips = await _list_clips(tx, [row.id for row in rows[:limit]])
    return Page(
        items=[_to_trial(row, user.id, clips.get(row.id, [])) for row in rows[:limit]],
        next_cursor=None if last is None else Cursor(last.created_at, last.id).encode(),
    )


async def list_all(tx: AsyncSession, user: User) -> list[Trial]:
    """List all of a user's trials, oldest first."""
    rows = list(
        await tx.scalars(
            select(TrialRow)
            .where(TrialRow.user_uuid == user.uuid)
            .order_by(TrialRow.created_at, TrialRow.id)
        )
    )
    clips = await _list_clips(tx, [row.id for row in rows])
    return [_to_trial(row, user.id, clips.get(row.id, [])) for row in rows]


async def list_stored(tx: AsyncSession, user_uuid: UUID) -> list[UUID]:
    """List the complete trials of a user, oldest first."""
    query = (
        select(TrialRow.id)
        .where(TrialRow.user_uuid == user_uuid, TrialRow.state == TrialState.STORED)
        .order_by(TrialRow.stored_at, TrialRow.id)
    )
    return list(await tx.scalars(query))


async def erase(tx: AsyncSession, user: User, trial_id: UUID, *, actor: UUID | None) -> None:
    """Erase a trial with all of its frames; versions that learned from it stay.

    Raises:
        UnknownTrialError: this user has none of that id.
        TrialConflictError: a stream is recording it; it must be cancelled there first.
    """
    row = await tx.scalar(
        select(TrialRow).where(TrialRow.id == trial_id, TrialRow.user_uuid == user.uuid)
    )
    if row is None:
        raise UnknownTrialError(f"There is no trial {trial_id}.")
    if row.state == TrialState.RECORDING:
        raise TrialConflictError("A stream is recording this trial; cancel it there.")
    await tx.execute(delete(TrialRow).where(TrialRow.id == trial_id))
    audit.record(tx, Action.TRIAL_ERASED, actor=actor, user_uuid=user.uuid)


async def read_clips(tx: AsyncSession, trial_id: UUID) -> list[StoredClip]:
    """Read the clips of one trial with their frames, in order."""
    rows = await tx.execute(
        select(ClipRow, ChunkRow.payload)
        .join(
            ChunkRow,
            (ChunkRow.trial_id == ClipRow.trial_id) & (ChunkRow.clip == ClipRow.ordinal),
        )
        .where(ClipRow.trial_id == trial_id)
        .order_by(ClipRow.ordinal, ChunkRow.ordinal)
    )
    infos: dict[int, ClipInfo] = {}
    chunks: dict[int, list[bytes]] = {}
    for row, payload in rows:
        infos.setdefault(row.ordinal, _to_clip(row))
        chunks.setdefault(row.ordinal, []).append(payload)
    return [StoredClip(trial_id, infos[i], tuple(chunks[i])) for i in sorted(infos)]


async def iterate_clips(tx: AsyncSession, trial_ids: Sequence[UUID]) -> AsyncIterator[StoredClip]:
    """Read the clips of several trials, one trial at a time, in the order of the list."""
    for trial_id in trial_ids:
        for clip in await read_clips(tx, trial_id):
            yield clip


async def clear_flaw(tx: AsyncSession, trial_ids: Sequence[UUID], *, flaw: ClipFlaw) -> None:
    """Take one kind of flaw back from all clips of some trials, before they are judged again."""
    await tx.execute(
        update(ClipRow)
        .where(ClipRow.trial_id.in_(trial_ids), ClipRow.flaw == flaw)
        .values(flaw=None)
    )


async def mark_flaw(tx: AsyncSession, trial_id: UUID, ordinal: int, *, flaw: ClipFlaw) -> None:
    """Note what is wrong with a clip, once it was looked at more closely."""
    await tx.execute(
        update(ClipRow)
        .where(ClipRow.trial_id == trial_id, ClipRow.ordinal == ordinal)
        .values(flaw=flaw)
    )


async def _list_clips(tx: AsyncSession, trial_ids: Sequence[UUID]) -> dict[UUID, list[ClipInfo]]:
    found: dict[UUID, list[ClipInfo]] = {}
    query = (
        select(ClipRow)
        .where(ClipRow.trial_id.in_(trial_ids))
        .order_by(ClipRow.trial_id, ClipRow.ordinal)
    )
    for row in await tx.scalars(query):
        found.setdefault(row.trial_id, []).append(_to_clip(row))
    return found


def _to_clip_row(trial_id: UUID, info: ClipInfo) -> ClipRow:
    return ClipRow(
        trial_id=trial_id,
        ordinal=info.ordinal,
        action=info.action,
        frames=info.frames,
        seconds=info.seconds,
        flaw=info.flaw,
    )


def _to_clip(row: ClipRow) -> ClipInfo:
    return ClipInfo(
        ordinal=row.ordinal,
        action=row.action,
        frames=row.frames,
        seconds=row.seconds,
        flaw=None if row.flaw is None else ClipFlaw(row.flaw),
    )


def _to_trial(row: TrialRow, user_id: str, clips: Sequence[ClipInfo]) -> Trial:
    return Trial(
        id=row.id,
        user=user_id,
        label=row.label,
        state=TrialState(row.state),
        source=TrialSource(row.source),
        finetune=row.finetune,
        clips=tuple(clips),
        created_at=row.created_at,
        stored_at=row.stored_at,
    )
