"""Trials recorded by a stream, chunk by chunk, on both databases."""

from datetime import timedelta
from uuid import uuid4

import numpy as np
import pytest
import pytest_asyncio

from app.domain.access import Scope
from app.domain.errors import (
    FencedError,
    TrialConflictError,
    UnknownTrialError,
    UserDeletedError,
)
from app.domain.recordings import RawFrames, pack_frames, unpack_frames
from app.domain.trials import ClipFlaw, TrialState
from app.storage import recordings, sessions, trials, users
from app.storage.abandoned import store_abandoned
from app.storage.recordings import Chunk
from tests.personal_support import START, add_key, add_user, record_frames

pytestmark = pytest.mark.asyncio
FRAMES = record_frames(2.0)


@pytest_asyncio.fixture
async def user(database):
    async with database.write() as tx:
        return await add_user(tx)


@pytest_asyncio.fixture
async def key(database):
    async with database.write() as tx:
        return await add_key(tx, Scope.ADMIN)


async def open_stream(database, user, key):
    return await sessions.open_session(
        database, user_uuid=user.uuid, name="robot", key_id=key.id, is_admin=True
    )


async def start(database, user, epoch, trial_id=None):
    async with database.write() as tx:
        return await recordings.start(
            tx,
            user.uuid,
            trial_id or uuid4(),
            label=None,
            session="robot",
            epoch=epoch,
            now=START,
        )


def take(begin, end):
    part = RawFrames(t=FRAMES.t[begin:end], joints=FRAMES.joints[begin:end])
    return Chunk(0, "wave", end - begin, float(FRAMES.t[end - 1]), pack_frames(part))


async def append(database, held, begin, end, *, now=START):
    async with database.write() as tx:
        await recordings.append(tx, held, take(begin, end), stored_seq=end, now=now)


async def stop(database, held, flaws=()):
    async with database.write() as tx:
        return await recordings.stop(tx, held, finetune=True, flaws=dict(flaws), now=START)


async def read(database, user, held):
    async with database.read() as tx:
        return await trials.get(tx, user, held.trial_id)


async def test_chunks_come_back_as_one_clip(database, user, key):
    held = await start(database, user, await open_stream(database, user, key))
    await append(database, held, 0, 20)
    await append(database, held, 20, 50)
    await stop(database, held)
    trial = await read(database, user, held)
    assert (trial.state, trial.source, trial.frames, trial.finetune) == (
        "stored",
        "stream",
        50,
        True,
    )
    async with database.read() as tx:
        (clip,) = await trials.read_clips(tx, held.trial_id)
        assert await trials.list_stored(tx, user.uuid) == [held.trial_id]
    stored = unpack_frames(clip.chunks)
    assert np.array_equal(stored.joints, FRAMES.joints[:50])


async def test_starting_again_changes_nothing(database, user, key):
    epoch = await open_stream(database, user, key)
    trial_id = uuid4()
    held = await start(database, user, epoch, trial_id)
    await append(database, held, 0, 5)
    again = await start(database, user, epoch, trial_id)
    assert (again.trial_id, again.stored_seq, again.clips) == (trial_id, 5, 1)
    await stop(database, held)
    with pytest.raises(TrialConflictError):
        await start(database, user, epoch, trial_id)


async def test_starting_again_after_a_reconnect_goes_on(database, user, key):
    trial_id = uuid4()
    old = await start(database, user, await open_stream(database, user, key), trial_id)
    await append(database, old, 0, 5)
    new = await start(database, user, await open_stream(database, user, key), trial_id)
    assert (new.stored_seq, new.clips, new.frames) == (5, 1, 5)
    with pytest.raises(FencedError):
        await append(database, old, 5, 9)


async def test_steps_that_are_repeated_change_nothing(database, user, key):
    held = await start(database, user, await open_stream(database, user, key))
    await append(database, held, 0, 20)
    await append(database, held, 0, 20)
    assert (await read(database, user, held)).frames == 20
    assert await stop(database, held)
    assert not await stop(database, held)
    other = await start(database, user, held.epoch)
    for _ in range(2):
        async with database.write() as tx:
            await recordings.cancel(tx, other, now=START)
    assert (await read(database, user, other)).state == TrialState.CANCELLED


async def test_tail_is_the_newest_chunk_of_the_last_clip(database, user, key):
    held = await start(database, user, await open_stream(database, user, key))
    async with database.read() as tx:
        assert await recordings.read_tail(tx, held.trial_id) is None
    await append(database, held, 0, 20)
    await append(database, held, 20, 30)
    async with database.read() as tx:
        tail = await recordings.read_tail(tx, held.trial_id)
    assert (tail.clip, tail.action, tail.frames) == (0, "wave", 30)
    assert unpack_frames([tail.payload]).t[-1] == FRAMES.t[29]


async def test_erased_person_ends_the_recording(database, user, key):
    held = await start(database, user, await open_stream(database, user, key))
    async with database.write() as tx:
        await users.erase(tx, user.id, actor=None, audit_key=b"k")
    with pytest.raises(UserDeletedError):
        await append(database, held, 0, 20)


async def test_newer_stream_takes_the_recording_over(database, user, key):
    old = await start(database, user, await open_stream(database, user, key))
    await append(database, old, 0, 10)
    epoch = await open_stream(database, user, key)
    with pytest.raises(FencedError):
        await append(database, old, 10, 20)
    async with database.write() as tx:
        new = await recordings.resume(
            tx, user.uuid, old.trial_id, session="robot", epoch=epoch, now=START
        )
    assert (new.stored_seq, new.clips) == (10, 1)
    await append(database, new, 10, 30)
    for end in (lambda: stop(database, old), lambda: append(database, old, 10, 20)):
        with pytest.raises(FencedError):
            await end()
    await stop(database, new)
    assert (await read(database, user, new)).frames == 30


async def test_stream_that_was_fenced_cannot_begin(database, user, key):
    epoch = await open_stream(database, user, key)
    await open_stream(database, user, key)
    with pytest.raises(FencedError):
        await start(database, user, epoch)


async def test_cancelled_recording_leaves_no_frame(database, user, key):
    held = await start(database, user, await open_stream(database, user, key))
    await append(database, held, 0, 40)
    async with database.write() as tx:
        await recordings.cancel(tx, held, now=START)
    trial = await read(database, user, held)
    assert (trial.state, trial.frames) == (TrialState.CANCELLED, 0)
    with pytest.raises(TrialConflictError):
        await append(database, held, 40, 50)


async def test_flaws_are_noted_at_the_end(database, user, key):
    held = await start(database, user, await open_stream(database, user, key))
    await append(database, held, 0, 20)
    await stop(database, held, {0: ClipFlaw.TOO_SHORT})
    assert (await read(database, user, held)).clips[0].flaw is ClipFlaw.TOO_SHORT


async def test_recording_without_a_stream_is_stored_without_a_job(database, user, key):
    held = await start(database, user, await open_stream(database, user, key))
    await append(database, held, 0, 40, now=START + timedelta(seconds=30))
    for cutoff, expected in ((30, []), (31, [held.trial_id])):
        async with database.write() as tx:
            before = START + timedelta(seconds=cutoff)
            assert await store_abandoned(tx, before=before, now=before) == expected
    trial = await read(database, user, held)
    assert (trial.state, trial.finetune) == (TrialState.STORED, False)


async def test_only_ones_own_recording_can_be_resumed(database, user, key):
    epoch = await open_stream(database, user, key)
    held = await start(database, user, epoch)
    async with database.write() as tx:
        other = await add_user(tx, "bob")
    with pytest.raises(UnknownTrialError):
        async with database.write() as tx:
            await recordings.resume(
                tx, other.uuid, held.trial_id, session="robot", epoch=epoch, now=START
            )
    await stop(database, held)
    with pytest.raises(TrialConflictError):
        async with database.write() as tx:
            await recordings.resume(
                tx, user.uuid, held.trial_id, session="robot", epoch=epoch, now=START
            )
