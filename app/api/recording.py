"""What a stream records, on its way into the database: where the two flows meet."""

import asyncio

from app.domain.errors import NotReadyError, TrialConflictError
from app.domain.recordings import DamagedChunkError, pack_frames, unpack_frames
from app.domain.streams import OpenStream
from app.domain.trials import ClipFlaw
from app.domain.users import User
from app.live.protocol import JobNote
from app.live.steps import (
    Append,
    Begin,
    Cancel,
    Done,
    Finish,
    Finished,
    LastClip,
    Opened,
    Outcome,
    Over,
    Portion,
    Resume,
    Step,
)
from app.live.tape import to_raw
from app.personalize.finish import examine, store_recording
from app.storage import recordings, trials
from app.storage.clock import read_clock
from app.storage.database import Database
from app.storage.recordings import Chunk, Recording, Tail
from models.skeleton import SKELETONS

STEP_S = 30.0
"""A step that takes longer counts as an outage of the database."""


class TrialArchive:
    """Stores the recordings of one stream, as `app.live.steps.Archive` describes it.

    Args:
        database: where.
        user: whose.
        stream: what the database knows the stream by.
    """

    def __init__(self, database: Database, user: User, stream: OpenStream) -> None:
        self._database, self._user, self._stream = database, user, stream
        self._joints = len(SKELETONS[user.skeleton].joints)
        self._recording: Recording | None = None

    async def __call__(self, step: Step) -> Outcome:
        """Carry out a step.

        Raises:
            NotReadyError: the database cannot be reached; it may have been carried out or not.
            KinecastError: it cannot be carried out.
        """
        try:
            async with asyncio.timeout(STEP_S):
                return await self._perform(step)
        except TimeoutError:
            raise NotReadyError("The database takes too long.") from None

    async def _perform(self, step: Step) -> Outcome:
        match step:
            case Begin() | Resume():
                return await self._open(step)
            case Finish(finetune=finetune):
                return Finished(await self._finish(finetune=finetune))
            case Append(portions=portions):
                await self._append(portions)
            case _:
                change = recordings.cancel if isinstance(step, Cancel) else recordings.touch
                async with self._database.write() as tx:
                    await change(tx, self._held, now=await read_clock(tx))
        return Done()

    async def _open(self, step: Begin | Resume) -> Opened | Over:
        user_uuid, session, epoch = self._user.uuid, self._stream.session, self._stream.epoch
        async with self._database.write() as tx:
            ended = await recordings.find_ended(tx, user_uuid, step.trial)
            if ended is not None:
                job = ended.job
                note = None if job is None else JobNote(job.id, job.state)
                return Over(ended.state, ended.stored_seq, note)
            now = await read_clock(tx)
            if isinstance(step, Begin):
                held = await recordings.start(
                    tx,
                    user_uuid,
                    step.trial,
                    label=step.label,
                    session=session,
                    epoch=epoch,
                    now=now,
                )
            else:
                held = await recordings.resume(
                    tx, user_uuid, step.trial, session=session, epoch=epoch, now=now
                )
            tail = await recordings.read_tail(tx, step.trial)
        self._recording = held
        last = None if tail is None else _find_last(tail)
        return Opened(held.stored_seq, held.frames, held.clips, last)

    async def _append(self, portions: tuple[Portion, ...]) -> None:
        chunks = await asyncio.to_thread(self._pack, portions)
        async with self._database.write() as tx:
            now = await read_clock(tx)
            for portion, chunk in zip(portions, chunks, strict=True):
                await recordings.append(
                    tx, self._held, chunk, stored_seq=portion.stored_seq, now=now
                )

    def _pack(self, portions: tuple[Portion, ...]) -> list[Chunk]:
        return [
            Chunk(
                clip=portion.clip,
                action=portion.action,
                frames=len(portion.frames),
                seconds=portion.seconds,
                payload=pack_frames(to_raw(portion.frames, joints=self._joints)),
            )
            for portion in portions
        ]

    async def _finish(self, *, finetune: bool) -> JobNote | None:
        held, user = self._held, self._user
        flaws: list[tuple[int, ClipFlaw | None]] = []
        async with self._database.read() as tx:
            clips = await trials.read_clips(tx, held.trial_id)
        for clip in clips:
            flaw = await asyncio.to_thread(examine, clip, skeleton=user.skeleton, up=user.up)
            flaws.append((clip.info.ordinal, flaw))
        async with self._database.write() as tx:
            job = await store_recording(
                tx,
                user,
                held,
                flaws,
                finetune=finetune,
                requested_by=self._stream.key_id,
                now=await read_clock(tx),
            )
        return None if job is None else JobNote(job.id, job.state)

    @property
    def _held(self) -> Recording:
        if self._recording is None:
            raise TrialConflictError("No trial is being recorded.")
        return self._recording


def _find_last(tail: Tail) -> LastClip | None:
    """Tell when the last clip began and how far it is stored; None where that cannot be read."""
    try:
        newest = float(unpack_frames([tail.payload]).t[-1])
    except DamagedChunkError:
        return None
    return LastClip(tail.clip, tail.action, tail.frames, newest - tail.seconds, newest)
