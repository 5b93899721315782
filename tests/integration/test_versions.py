"""Versions, their weights, and which one is active, on both databases."""

from uuid import uuid4

import pytest
from sqlalchemy import func, select, text
from sqlalchemy.exc import IntegrityError

from app.domain.errors import (
    ActiveChangedError,
    UnknownTrialError,
    UnknownVersionError,
    WeightsDamagedError,
    WeightsPurgedError,
)
from app.domain.jobs import JobReason
from app.domain.trials import ClipFlaw
from app.domain.versions import ActiveVersion, Verdict
from app.storage import trials, users, versions, weights
from app.storage.tables import ChunkRow, VersionRow, WeightsRow
from tests.personal_support import (
    BASE_SHA256,
    add_trial,
    add_user,
    claim,
    enqueue,
    finish,
    make_clip,
    record_frames,
)

pytestmark = pytest.mark.asyncio


async def start(database, user_id="ada"):
    async with database.write() as tx:
        user = await add_user(tx, user_id)
        await add_trial(tx, user)
    return user


async def make(database, user, *, keep=10, **result):
    """One more version, as a job would make it."""
    async with database.write() as tx:
        await enqueue(tx, user)
    return await finish(database, await claim(database), keep=keep, **result)


async def read_active(database, user):
    async with database.read() as tx:
        return await versions.read_active_of(tx, user.uuid)


async def read_states(database, user):
    async with database.read() as tx:
        return [v.state.value for v in await versions.list_all(tx, user.uuid)]


async def promote(database, user, number, expected=None):
    async with database.write() as tx:
        await versions.promote(
            tx, user.uuid, number, expected=expected, base_sha256=BASE_SHA256, actor=None
        )


async def roll_back(database, user, expected=None):
    async with database.write() as tx:
        return await versions.roll_back(
            tx, user.uuid, expected=expected, base_sha256=BASE_SHA256, actor=None
        )


async def test_winner_is_active_with_all_that_is_known_of_it(database):
    user = await start(database)
    assert await read_active(database, user) == ActiveVersion()
    assert await make(database, user, blob=b"one") is JobReason.PROMOTED
    async with database.read() as tx:
        version = await versions.get(tx, user.uuid, 1)
        blob = await weights.get(tx, version.sha256)
    assert (blob, version.size, version.parent, version.state) == (b"one", 3, 0, "active")
    assert version.metrics == {"before": [1.0], "after": [0.5]}
    assert len(version.trained_on) == 1
    assert await read_active(database, user) == ActiveVersion(1, version.sha256, BASE_SHA256)


async def test_next_winner_retires_the_one_before(database):
    user = await start(database)
    await make(database, user)
    await make(database, user, parent=1)
    assert await read_states(database, user) == ["retired", "active"]


async def test_loser_keeps_its_figures_and_changes_nothing(database):
    user = await start(database)
    await make(database, user)
    assert await make(database, user, verdict=Verdict.REJECT) is JobReason.DID_NOT_WIN
    assert await read_states(database, user) == ["active", "rejected"]


async def test_winner_over_what_is_not_active_any_more_waits(database):
    user = await start(database)
    await make(database, user)
    assert await make(database, user, parent=0) is JobReason.AWAITS_PROMOTION
    assert await read_states(database, user) == ["active", "candidate"]


async def test_database_itself_refuses_a_second_active_version(database):
    user = await start(database)
    await make(database, user)
    await make(database, user, verdict=Verdict.REJECT)
    with pytest.raises(IntegrityError):
        async with database.write() as tx:
            await tx.execute(text("UPDATE versions SET state = 'active'"))


async def test_numbers_are_never_used_again(database):
    user = await start(database)
    await make(database, user)
    async with database.write() as tx:
        await tx.execute(text("DELETE FROM versions"))
    await make(database, user)
    async with database.read() as tx:
        assert [v.number for v in await versions.list_all(tx, user.uuid)] == [2]


async def test_after_a_rollback_the_next_trial_promotes_nothing(database):
    user = await start(database)
    await make(database, user)
    await make(database, user, parent=1)
    assert await roll_back(database, user) == 1
    assert await make(database, user, parent=1) is JobReason.AWAITS_PROMOTION
    async with database.write() as tx:
        await users.change(tx, "ada", {"auto_promote": True}, actor=None)
    assert await make(database, user, parent=1) is JobReason.PROMOTED


async def test_weights_that_were_rolled_back_are_never_promoted_by_themselves(database):
    user = await start(database)
    await make(database, user, blob=b"bad")
    assert await roll_back(database, user) == 0
    async with database.write() as tx:
        await users.change(tx, "ada", {"auto_promote": True}, actor=None)
    assert await make(database, user, blob=b"bad") is JobReason.AWAITS_PROMOTION


async def test_rollback_passes_over_what_was_rolled_back(database):
    user = await start(database)
    for parent in (0, 1):
        await make(database, user, parent=parent)
    assert await roll_back(database, user) == 1
    await promote(database, user, 0)
    assert (await read_active(database, user)).number == 0
    assert await roll_back(database, user) == 1
    assert await roll_back(database, user) == 0
    assert await roll_back(database, user) == 0
    assert await read_states(database, user) == ["retired", "retired"]


async def test_operator_may_promote_what_the_judge_rejected(database):
    user = await start(database)
    await make(database, user, verdict=Verdict.REJECT)
    await promote(database, user, 1)
    assert await read_states(database, user) == ["active"]
    with pytest.raises(UnknownVersionError):
        await promote(database, user, 2)
    assert await read_states(database, user) == ["active"]


async def test_decision_on_an_old_view_is_refused(database):
    user = await start(database)
    await make(database, user, blob=b"one")
    for decide in (
        lambda: promote(database, user, 0, "f" * 64),
        lambda: roll_back(database, user, BASE_SHA256),
    ):
        with pytest.raises(ActiveChangedError):
            await decide()
    active = await read_active(database, user)
    assert active.number == 1
    await promote(database, user, 0, active.sha256)
    await promote(database, user, 1, BASE_SHA256)


async def test_what_is_active_already_is_not_activated_again(database):
    user = await start(database)
    for parent in (0, 1):
        await make(database, user, parent=parent)
    await promote(database, user, 2)
    async with database.read() as tx:
        assert [line.number for line in await versions.list_history(tx, user.uuid)] == [1, 2]
        assert (await users.get(tx, "ada")).auto_promote is False
    assert await roll_back(database, user) == 1  # not to itself
    for _ in range(2):
        await promote(database, user, 0)
    assert await roll_back(database, user) == 1
    assert await make(database, user, parent=1) is JobReason.AWAITS_PROMOTION


async def test_old_weights_are_purged_and_their_figures_stay(database):
    user = await start(database)
    for parent in range(4):
        await make(database, user, parent=parent, keep=1)
    async with database.read() as tx:
        every = await versions.list_all(tx, user.uuid)
        assert [v.purged for v in every] == [True, True, False, False]
        assert await tx.scalar(select(func.count()).select_from(WeightsRow)) == 2
        with pytest.raises(WeightsPurgedError):
            await weights.get(tx, every[0].sha256)
    with pytest.raises(WeightsPurgedError):
        await promote(database, user, 1)
    assert await roll_back(database, user) == 3
    assert await roll_back(database, user) == 0  # the others cannot be used any more


async def test_equal_weights_of_two_users_are_stored_once_and_erased_with_the_last(database):
    ada, bob = await start(database), await start(database, "bob")
    for user in (ada, bob):
        await make(database, user, blob=b"same")
    async with database.write() as tx:
        await weights.put(tx, b"base", kind="base")
        assert await tx.scalar(select(func.count()).select_from(WeightsRow)) == 2
    for user_id, left in (("ada", 2), ("bob", 1)):
        async with database.write() as tx:
            await users.erase(tx, user_id, actor=None, audit_key=b"audit")
            assert await tx.scalar(select(func.count()).select_from(WeightsRow)) == left


async def test_damaged_weights_are_noticed(database):
    user = await start(database)
    await make(database, user, blob=b"one")
    async with database.write() as tx:
        version = await versions.get(tx, user.uuid, 1)
        await tx.execute(WeightsRow.__table__.update().values(blob=b"two"))
    async with database.read() as tx:
        with pytest.raises(WeightsDamagedError):
            await weights.get(tx, version.sha256)


async def test_trial_comes_back_as_it_was_stored(database):
    frames = record_frames()
    async with database.write() as tx:
        user = await add_user(tx)
        clips = [make_clip(0, frames=frames), make_clip(1, flaw=ClipFlaw.TOO_SHORT)]
        made = await trials.add(tx, user, label="one", finetune=False, clips=clips)
    async with database.read() as tx:
        assert await trials.get(tx, user, made.id) == made
        assert (await trials.list_page(tx, user, after=None, limit=5)).items == [made]
        stored = await trials.read_clips(tx, made.id)
    assert [clip.info for clip in stored] == [clip.info for clip in clips]
    assert [clip.chunks for clip in stored] == [(clip.payload,) for clip in clips]


async def test_erased_trial_leaves_no_frame(database):
    async with database.write() as tx:
        user, other = await add_user(tx), await add_user(tx, "bob")
        made = await add_trial(tx, user, clips=3)
    for stranger, trial_id in ((other, made.id), (user, uuid4())):
        with pytest.raises(UnknownTrialError):
            async with database.write() as tx:
                await trials.erase(tx, stranger, trial_id, actor=None)
    async with database.write() as tx:
        await trials.erase(tx, user, made.id, actor=None)
    async with database.read() as tx:
        assert await tx.scalar(select(func.count()).select_from(ChunkRow)) == 0
        with pytest.raises(UnknownTrialError):
            await trials.get(tx, user, made.id)


async def test_what_is_active_is_told_for_many_users_at_once(database):
    ada, bob = await start(database), await start(database, "bob")
    await make(database, ada)
    async with database.read() as tx:
        found = await versions.read_active(tx, [ada.uuid, bob.uuid])
        sha256 = await tx.scalar(select(VersionRow.sha256))
    assert found == {ada.uuid: ActiveVersion(1, sha256, BASE_SHA256)}


async def test_next_step_down_is_what_a_rollback_would_lead_to(database):
    user = await start(database)
    for parent in (0, 1):
        await make(database, user, parent=parent)
    async with database.read() as tx:
        assert (await versions.read_previous(tx, user.uuid)).number == 1
    await promote(database, user, 1)
    async with database.read() as tx:
        assert (await versions.read_previous(tx, user.uuid)).number == 2
