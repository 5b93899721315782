"""Trials that a stream records: chunk by chunk, so that a crash costs a second at most.

A recording belongs to one epoch of a stream session. Whatever an older epoch still writes is
refused, so that two streams that both think they record cannot mix their frames.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import NoReturn
from uuid import UUID

from sqlalchemy import (
    ColumnElement,
    Exists,
    delete,
    exists,
    func,
    or_,
    select,
    update,
)
from sqlalchemy.exc import IntegrityError
from sqlalchemy.ext.asyncio import AsyncSession

from app.domain.errors import (
    FencedError,
    TrialConflictError,
    UnknownTrialError,
    UserDeletedError,
)
from app.domain.jobs import Job
from app.domain.trials import ClipFlaw, TrialSource, TrialState
from app.storage import jobs
from app.storage.tables import ChunkRow, ClipRow, SessionRow, TrialRow, UserRow


@dataclass(frozen=True, slots=True)
class Recording:
    """The right to write to a trial, for as long as nobody takes its session over.

    Attributes:
        trial_id: which trial.
        user_uuid: whose.
        session, epoch: of the stream that records.
        stored_seq: the newest frame that is stored, None before the first.
        clips: how many ordinals of clips were given away.
        frames: how many frames are stored.
    """

    trial_id: UUID
    user_uuid: UUID
    session: str
    epoch: int
    stored_seq: int | None = None
    clips: int = 0
    frames: int = 0


@dataclass(frozen=True, slots=True)
class Ended:
    """How a recording ended.

    Attributes:
        state: stored or cancelled.
        stored_seq: its newest frame.
        job: what trains on it, None if nothing does.
    """

    state: TrialState
    stored_seq: int | None
    job: Job | None


@dataclass(frozen=True, slots=True)
class Tail:
    """Where a recording left off: its last clip, and the newest frames of it.

    Attributes:
        clip: ordinal of the clip.
        action: what the person did.
        frames: how many frames of it are stored.
        seconds: how long it is.
        payload: the newest chunk.
    """

    clip: int
    action: str | None
    frames: int
    seconds: float
    payload: bytes


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
    trial_id: UUID,
    *,
    label: str | None,
    session: str,
    epoch: int,
    now: datetime,
) -> Recording:
    """Begin a trial; beginning it again, also after a reconnect, goes on with it.

    Raises:
        TrialConflictError: the id belongs to another trial, or that one is complete.
        FencedError: a newer stream has the session.
    """
    row = await tx.get(TrialRow, trial_id, with_for_update=True)
    if row is not None:
        if row.user_uuid != user_uuid or row.state != TrialState.RECORDING:
            raise TrialConflictError(f"The id {trial_id} belongs to another trial.")
        return await _take_over(tx, row, session=session, epoch=epoch, now=now)
    if not await tx.scalar(select(_is_newest(user_uuid, session, epoch))):
        raise FencedError
    row = TrialRow(
        id=trial_id,
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
    try:
        await tx.flush()
    except IntegrityError:  # begun elsewhere at this very moment
        raise TrialConflictError(f"The id {trial_id} belongs to another trial.") from None
    return await _hold(tx, row)


async def find_ended(tx: AsyncSession, user_uuid: UUID, trial_id: UUID) -> Ended | None:
    """Tell how a recorded trial of this user ended, None if it did not."""
    row = await tx.get(TrialRow, trial_id)
    if row is None or row.user_uuid != user_uuid or row.source != TrialSource.STREAM:
        return None
    state = TrialState(row.state)
    if state is TrialState.RECORDING:
        return None
    job = None
    if row.finetune and row.stored_at is not None:
        job = await jobs.find_asked_at(tx, user_uuid, row.stored_at)
    return Ended(state, row.stored_seq, job)


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
    return await _take_over(tx, row, session=session, epoch=epoch, now=now)


async def append(
    tx: AsyncSession, held: Recording, chunk: Chunk, *, stored_seq: int, now: datetime
) -> None:
    """Store some frames; storing them again changes nothing.

    Args:
        tx: a transaction for writing.
        held: the recording.
        chunk: the frames.
        stored_seq: number of the newest of them.
        now: by `app.storage.clock`.

    Raises:
        FencedError: a newer stream has the session.
        TrialConflictError: another stream records this trial now, or it is complete.
        UserDeletedError: the user was erased.
    """
    is_new = or_(TrialRow.stored_seq.is_(None), TrialRow.stored_seq < stored_seq)
    if not await _change(tx, held, is_new, now=now, stored_seq=stored_seq):
        await touch(tx, held, now=now)
        return  # the answer to an earlier attempt was lost
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


async def touch(tx: AsyncSession, held: Recording, *, now: datetime) -> None:
    """Say that the stream of a recording is still there; raises as `append` does."""
    if not await _change(tx, held, now=now):
        await _explain(tx, held)


async def stop(
    tx: AsyncSession,
    held: Recording,
    *,
    finetune: bool,
    flaws: Mapping[int, ClipFlaw],
    now: datetime,
) -> bool:
    """Complete a trial. Whoever wants a job asks for it in the same transaction.

    Args:
        tx: a transaction for writing.
        held: the recording.
        finetune: whether a job was asked for.
        flaws: clips that are not to be trained on, by ordinal.
        now: by `app.storage.clock`.

    Returns:
        Whether this completed it; False where this stream had done so before.

    Raises:
        FencedError, TrialConflictError, UserDeletedError: as in `append`.
    """
    if await _was_ended(tx, held, TrialState.STORED):
        return False
    done = {"state": TrialState.STORED, "finetune": finetune, "stored_at": now}
    if not await _change(tx, held, now=now, **done):
        await _explain(tx, held)
    for ordinal, flaw in flaws.items():
        await tx.execute(
            update(ClipRow)
            .where(ClipRow.trial_id == held.trial_id, ClipRow.ordinal == ordinal)
            .values(flaw=flaw)
        )
    return True


async def cancel(tx: AsyncSession, held: Recording, *, now: datetime) -> None:
    """Call a recording off and erase its frames; doing so again changes nothing.

    Raises:
        FencedError, TrialConflictError, UserDeletedError: as in `append`.
    """
    if await _was_ended(tx, held, TrialState.CANCELLED):
        return
    if not await _change(tx, held, now=now, state=TrialState.CANCELLED):
        await _explain(tx, held)
    await tx.execute(delete(ClipRow).where(ClipRow.trial_id == held.trial_id))


async def read_tail(tx: AsyncSession, trial_id: UUID) -> Tail | None:
    """Read where a recording left off, None if it has no frames."""
    query = (
        select(ClipRow, ChunkRow.payload)
        .join(
            ChunkRow,
            (ChunkRow.trial_id == ClipRow.trial_id) & (ChunkRow.clip == ClipRow.ordinal),
        )
        .where(ClipRow.trial_id == trial_id)
        .order_by(ClipRow.ordinal.desc(), ChunkRow.ordinal.desc())
        .limit(1)
    )
    found = (await tx.execute(query)).one_or_none()
    if found is None:
        return None
    row, payload = found
    return Tail(row.ordinal, row.action, row.frames, row.seconds, payload)


def _is_newest(user_uuid: UUID, session: str, epoch: int) -> Exists:
    return exists().where(
        SessionRow.user_uuid == user_uuid, SessionRow.name == session, SessionRow.epoch == epoch
    )


async def _take_over(
    tx: AsyncSession, row: TrialRow, *, session: str, epoch: int, now: datetime
) -> Recording:
    if not await tx.scalar(select(_is_newest(row.user_uuid, session, epoch))):
        raise FencedError
    row.session, row.epoch, row.touched_at = session, epoch, now
    await tx.flush()
    return await _hold(tx, row)


async def _change(
    tx: AsyncSession,
    held: Recording,
    *conditions: ColumnElement[bool],
    now: datetime,
    **values: object,
) -> bool:
    """Change the trial, if this recording still may and the conditions hold; tells whether."""
    changed = await tx.scalar(
        update(TrialRow)
        .where(
            TrialRow.id == held.trial_id,
            TrialRow.state == TrialState.RECORDING,
            TrialRow.session == held.session,
            TrialRow.epoch == held.epoch,
            _is_newest(held.user_uuid, held.session, held.epoch),
            *conditions,
        )
        .values(touched_at=now, **values)
        .returning(TrialRow.id)
        .execution_options(synchronize_session=False)
    )
    return changed is not None


async def _explain(tx: AsyncSession, held: Recording) -> NoReturn:
    """Say why a recording may not be changed any more."""
    if not await tx.scalar(select(exists().where(UserRow.uuid == held.user_uuid))):
        raise UserDeletedError
    if not await tx.scalar(select(_is_newest(held.user_uuid, held.session, held.epoch))):
        raise FencedError
    state = await tx.scalar(select(TrialRow.state).where(TrialRow.id == held.trial_id))
    if state == TrialState.RECORDING:
        raise TrialConflictError("Another stream goes on with this recording.")
    raise TrialConflictError(f"The trial is {state or 'erased'}.")


async def _was_ended(tx: AsyncSession, held: Recording, state: TrialState) -> bool:
    """Tell whether this very stream ended the trial: the answer to that was lost."""
    is_stored = state == TrialState.STORED
    mine = exists().where(
        TrialRow.id == held.trial_id,
        TrialRow.state == state,
        TrialRow.session == held.session,
        TrialRow.epoch == held.epoch,
        # one that was abandoned was touched before it was stored
        TrialRow.stored_at == TrialRow.touched_at if is_stored else TrialRow.stored_at.is_(None),
    )
    return bool(await tx.scalar(select(mine)))


async def _hold(tx: AsyncSession, row: TrialRow) -> Recording:
    last, frames = (
        await tx.execute(
            select(func.max(ClipRow.ordinal), func.sum(ClipRow.frames)).where(
                ClipRow.trial_id == row.id
            )
        )
    ).one()
    return Recording(
        trial_id=row.id,
        user_uuid=row.user_uuid,
        session=row.session or "",
        epoch=row.epoch or 0,
        stored_seq=row.stored_seq,
        clips=0 if last is None else last + 1,
        frames=frames or 0,
    )
