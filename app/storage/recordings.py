"""Trials that a stream records: chunk by chunk, so that a crash costs a second at most.

A recording belongs to one epoch of a stream session. Whatever an older epoch still writes is
refused, so that two streams that both think they record cannot mix their frames.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from uuid import UUID, uuid4

from sqlalchemy import Exists, delete, exists, func, select, update
from sqlalchemy.ext.asyncio import AsyncSession

from app.domain.errors import FencedError, TrialConflictError, UnknownTrialError
from app.domain.trials import ClipFlaw, TrialSource, TrialState
from app.storage.tables import ChunkRow, ClipRow, SessionRow, TrialRow


@dataclass(frozen=True, slots=True)
class Recording:
    """The right to write to a trial, for as long as nobody takes its session over.

    Attributes:
        trial_id: which trial.
        user_uuid: whose.
        session, epoch: of the stream that records.
        stored_seq: the newest frame that is stored, None before the first.
        clips: how many clips were begun.
    """

    trial_id: UUID
    user_uuid: UUID
    session: str
    epoch: int
    stored_seq: int | None = None
    clips: int = 0


@dataclass(frozen=True, slots=True)
class Chunk:
    """Some frames of a clip.

    Attributes:
        clip: ordinal of the clip within the trial.
        action: what the person does.
        frames: how many frames are packed.
        seconds: how long the clip is with them.
        payload: the frames, packed.
    """

    clip: int
    action: str | None
    frames: int
    seconds: float
    payload: bytes


async def start(
    tx: AsyncSession,
    user_uuid: UUID,
    *,
    trial_id: UUID | None,
    label: str | None,
    session: str,
    epoch: int,
    now: datetime,
) -> Recording:
    """Begin a trial; beginning it again from the same stream changes nothing.

    Raises:
        TrialConflictError: the id belongs to another trial, or that one is complete.
        FencedError: a newer stream has the session.
    """
    row = None if trial_id is None else await tx.get(TrialRow, trial_id)
    if row is not None:
        mine = row.user_uuid == user_uuid and row.state == TrialState.RECORDING
        if not mine or (row.session, row.epoch) != (session, epoch):
            raise TrialConflictError(f"The id {trial_id} belongs to another trial.")
        return await _hold(tx, row)
    if not await tx.scalar(select(_is_newest(user_uuid, session, epoch))):
        raise FencedError
    row = TrialRow(
        id=trial_id or uuid4(),
        user_uuid=user_uuid,
        label=label,
        state=TrialState.RECORDING,
        source=TrialSource.STREAM,
        finetune=False,
        session=session,
        epoch=epoch,
        created_at=now,
        touched_at=now,
    )
    tx.add(row)
    await tx.flush()
    return await _hold(tx, row)


async def resume(
    tx: AsyncSession, user_uuid: UUID, trial_id: UUID, *, session: str, epoch: int, now: datetime
) -> Recording:
    """Go on with a recording after a reconnect, also of another session's; tells what is stored.

    Raises:
        UnknownTrialError: this user has no such trial.
        TrialConflictError: it is complete, or was cancelled.
        FencedError: a newer stream has the session.
    """
    row = await tx.get(TrialRow, trial_id, with_for_update=True)
    if row is None or row.user_uuid != user_uuid:
        raise UnknownTrialError(f"There is no trial {trial_id}.")
    if row.state != TrialState.RECORDING:
        raise TrialConflictError(f"The trial is {row.state}.")
    if not await tx.scalar(select(_is_newest(user_uuid, session, epoch))):
        raise FencedError
    row.session, row.epoch, row.touched_at = session, epoch, now
    await tx.flush()
    return await _hold(tx, row)


async def append(
    tx: AsyncSession, held: Recording, chunk: Chunk, *, stored_seq: int, now: datetime
) -> None:
    """Store some frames.

    Raises:
        FencedError: another stream records this trial now, or it is complete.
    """
    await _touch(tx, held, now=now, stored_seq=stored_seq)
    clip = await tx.get(ClipRow, (held.trial_id, chunk.clip))
    if clip is None:
        clip = ClipRow(
            trial_id=held.trial_id, ordinal=chunk.clip, action=chunk.action, frames=0, seconds=0.0
        )
        tx.add(clip)
    clip.frames += chunk.frames
    clip.seconds = chunk.seconds
    await tx.flush()
    last = await tx.scalar(
        select(func.max(ChunkRow.ordinal)).where(
            ChunkRow.trial_id == held.trial_id, ChunkRow.clip == chunk.clip
        )
    )
    tx.add(
        ChunkRow(
            trial_id=held.trial_id,
            clip=chunk.clip,
            ordinal=0 if last is None else last + 1,
            frames=chunk.frames,
            payload=chunk.payload,
        )
    )
    await tx.flush()


async def stop(
    tx: AsyncSession,
    held: Recording,
    *,
    finetune: bool,
    flaws: Mapping[int, ClipFlaw],
    now: datetime,
) -> None:
    """Complete a trial. Whoever wants a job asks for it in the same transaction.

    Args:
        tx: a transaction for writing.
        held: the recording.
        finetune: whether a job was asked for.
        flaws: clips that are not to be trained on, by ordinal.
        now: the moment.

    Raises:
        FencedError: another stream records this trial now, or it is complete.
    """
    await _touch(tx, held, now=now, state=TrialState.STORED, finetune=finetune, stored_at=now)
    for ordinal, flaw in flaws.items():
        await tx.execute(
            update(ClipRow)
            .where(ClipRow.trial_id == held.trial_id, ClipRow.ordinal == ordinal)
            .values(flaw=flaw)
        )


async def cancel(tx: AsyncSession, held: Recording, *, now: datetime) -> None:
    """Call a recording off and erase its frames.

    Raises:
        FencedError: another stream records this trial now, or it is complete.
    """
    await _touch(tx, held, now=now, state=TrialState.CANCELLED)
    await tx.execute(delete(ClipRow).where(ClipRow.trial_id == held.trial_id))


async def store_abandoned(tx: AsyncSession, *, before: datetime, now: datetime) -> list[UUID]:
    """Complete recordings whose stream is silent since then, without a job; gives their ids."""
    rows = await tx.scalars(
        update(TrialRow)
        .where(TrialRow.state == TrialState.RECORDING, TrialRow.touched_at < before)
        .values(state=TrialState.STORED, finetune=False, stored_at=now)
        .returning(TrialRow.id)
        .execution_options(synchronize_session=False)
    )
    return list(rows)


def _is_newest(user_uuid: UUID, session: str, epoch: int) -> Exists:
    return exists().where(
        SessionRow.user_uuid == user_uuid, SessionRow.name == session, SessionRow.epoch == epoch
    )


async def _touch(tx: AsyncSession, held: Recording, *, now: datetime, **values: object) -> None:
    """Change the trial, if this recording still may."""
    changed = await tx.scalar(
        update(TrialRow)
        .where(
            TrialRow.id == held.trial_id,
            TrialRow.state == TrialState.RECORDING,
            TrialRow.session == held.session,
            TrialRow.epoch == held.epoch,
            _is_newest(held.user_uuid, held.session, held.epoch),
        )
        .values(touched_at=now, **values)
        .returning(TrialRow.id)
        .execution_options(synchronize_session=False)
    )
    if changed is None:
        raise FencedError("Another stream records this trial, or it is complete.")


async def _hold(tx: AsyncSession, row: TrialRow) -> Recording:
    clips = await tx.scalar(
        select(func.count()).select_from(ClipRow).where(ClipRow.trial_id == row.id)
    )
    return Recording(
        trial_id=row.id,
        user_uuid=row.user_uuid,
        session=row.session or "",
        epoch=row.epoch or 0,
        stored_seq=row.stored_seq,
        clips=clips or 0,
    )
