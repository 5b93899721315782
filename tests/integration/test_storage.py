import asyncio
from datetime import UTC, datetime, timedelta, timezone
from uuid import uuid4

import pytest
from sqlalchemy import func, select, text
from sqlalchemy.exc import InternalError

from app.domain.access import BOOTSTRAP_KEY_ID, Scope
from app.domain.errors import (
    ForbiddenError,
    NotReadyError,
    UnauthorizedError,
    UnknownKeyError,
    UnknownUserError,
    UserDeletedError,
    UserExistsError,
)
from app.domain.events import Action
from app.domain.pagination import decode_cursor
from app.domain.streams import OpenStream, Verdict
from app.domain.users import pseudonym
from app.storage import audit, keys, sessions, users
from app.storage.database import Database, find_database
from app.storage.tables import AuditRow, Base, KeyRow
from tests.support import make_settings

pytestmark = pytest.mark.asyncio
AUDIT_KEY = b"audit"
PERSONAL_TABLES = (
    "trials",
    "clips",
    "chunks",
    "jobs",
    "weights",
    "versions",
    "activations",
    "idempotency",
)


async def add_user(database, user_id="ada"):
    async with database.write() as tx:
        return await users.create(
            tx,
            user_id=user_id,
            skeleton="kinect_v1",
            up="y",
            root_relative=False,
            display_name=None,
            actor=None,
        )


async def add_then_fail(database):
    """Write one line, then break off: a user of that id exists."""
    async with database.write() as tx:
        audit.record(tx, Action.USER_CHANGED, actor=None)
        await users.create(
            tx,
            user_id="ada",
            skeleton="kinect_v1",
            up="y",
            root_relative=False,
            display_name=None,
            actor=None,
        )


async def add_key(database, *scopes, user_uuid=None):
    async with database.write() as tx:
        return await keys.create(
            tx,
            scopes=frozenset(scopes or {Scope.PREDICT}),
            name=None,
            user_uuid=user_uuid,
            actor=None,
        )


async def count_rows(database):
    async with database.read() as tx:
        return {
            table.name: await tx.scalar(select(func.count()).select_from(table))
            for table in Base.metadata.sorted_tables
        }


async def test_user_ids_are_case_sensitive_and_unique(database):
    await add_user(database, "ada")
    await add_user(database, "Ada")
    with pytest.raises(UserExistsError):
        await add_user(database, "ada")


async def test_lists_are_newest_first_and_pages_join_without_gap(database):
    names = [f"user-{i}" for i in range(7)]
    for name in names:
        await add_user(database, name)
    seen, cursor = [], None
    while True:
        async with database.read() as tx:
            after = None if cursor is None else decode_cursor(cursor)
            page = await users.list_page(tx, after=after, limit=3)
        seen += [user.id for user in page.items]
        cursor = page.next_cursor
        if cursor is None:
            break
    assert seen == names[::-1]


async def test_instants_come_back_in_utc(database):
    user = await add_user(database)
    assert user.created_at.tzinfo is not None
    async with database.read() as tx:
        stored = await users.get(tx, "ada")
    assert stored.created_at == user.created_at
    assert stored.created_at.utcoffset() == timedelta(0)
    assert abs(datetime.now(UTC) - stored.created_at) < timedelta(minutes=1)


async def test_instant_of_another_zone_is_stored_as_the_same_moment(database):
    moment = datetime(2026, 5, 1, 12, tzinfo=timezone(timedelta(hours=9)))
    async with database.write() as tx:
        tx.add(KeyRow(id=uuid4(), sha256=b"", scopes=frozenset(Scope), created_at=moment))
    async with database.read() as tx:
        row = (await tx.scalars(select(KeyRow))).one()
        assert row.created_at == moment
        assert row.scopes == frozenset(Scope)


async def test_failed_write_leaves_nothing(database):
    await add_user(database)
    before = await count_rows(database)
    with pytest.raises(UserExistsError):
        await add_then_fail(database)
    assert await count_rows(database) == before


async def test_erasing_a_user_leaves_one_pseudonym_and_nothing_else(database):
    user = await add_user(database)
    bound = await add_key(database, user_uuid=user.uuid)
    await sessions.open_session(
        database, user_uuid=user.uuid, name="s", key_id=bound.id, is_admin=False
    )
    async with database.write() as tx:
        await users.erase(tx, "ada", actor=None, audit_key=AUDIT_KEY)
    assert await count_rows(database) == {
        "users": 0,
        "api_keys": 0,
        "stream_sessions": 0,
        "audit": 1,
        **dict.fromkeys(PERSONAL_TABLES, 0),
    }
    async with database.read() as tx:
        line = (await tx.scalars(select(AuditRow))).one()
    assert line.action == Action.USER_DELETED
    assert line.user_uuid is None
    assert line.subject == pseudonym("ada", key=AUDIT_KEY)
    assert "ada" not in line.subject


async def test_recreated_id_never_meets_old_data(database):
    old = await add_user(database)
    key = await add_key(database, user_uuid=old.uuid)
    async with database.write() as tx:
        await users.erase(tx, "ada", actor=None, audit_key=AUDIT_KEY)
    new = await add_user(database)
    assert new.uuid != old.uuid
    with pytest.raises(UnauthorizedError):
        await keys.authenticate(database, key.text)
    async with database.read() as tx:
        assert [e.action for e in await audit.list_of_user(tx, new.uuid)] == [Action.USER_CREATED]


async def test_erasing_or_renaming_nobody_is_an_error(database):
    for change in (
        lambda tx: users.erase(tx, "ada", actor=None, audit_key=AUDIT_KEY),
        lambda tx: users.change(tx, "ada", {"display_name": "Ada"}, actor=None),
        lambda tx: users.get(tx, "ada"),
    ):
        with pytest.raises(UnknownUserError):
            async with database.write() as tx:
                await change(tx)


async def test_key_is_found_by_its_text_and_by_nothing_else(database):
    user = await add_user(database)
    key = await add_key(database, Scope.PREDICT, Scope.RECORD, user_uuid=user.uuid)
    caller = (await keys.authenticate(database, key.text)).principal
    assert caller.key_id == key.id
    assert caller.scopes == {Scope.PREDICT, Scope.RECORD}
    assert caller.bound_user == "ada"
    changed = key.text[:-1] + ("a" if key.text[-1] != "a" else "b")
    for text_ in (changed, key.text[:-1], "", "x" * 44, key.text.upper()):
        with pytest.raises(UnauthorizedError):
            await keys.authenticate(database, text_)


async def test_secret_is_not_in_the_database(database):
    key = await add_key(database)
    async with database.read() as tx:
        row = (await tx.scalars(select(KeyRow))).one()
    assert key.text.split("_")[2] not in repr(vars(row))


async def test_revoked_key_stops_working(database):
    key = await add_key(database)
    async with database.write() as tx:
        await keys.revoke(tx, key.id, actor=None)
        await keys.revoke(tx, key.id, actor=None)
    with pytest.raises(UnauthorizedError):
        await keys.authenticate(database, key.text)
    with pytest.raises(UnknownKeyError):
        async with database.write() as tx:
            await keys.revoke(tx, uuid4(), actor=None)


async def test_last_use_is_kept_to_the_hour(database):
    key = await add_key(database)
    await keys.authenticate(database, key.text)
    async with database.read() as tx:
        first = (await keys.get(tx, key.id)).last_used_at
    await keys.authenticate(database, key.text)
    async with database.read() as tx:
        assert (await keys.get(tx, key.id)).last_used_at == first is not None


async def test_admin_key_of_the_settings_works_as_long_as_it_is_set(database):
    for text_, works in (("a" * 40, True), ("b" * 40, True), (None, False)):
        async with database.write() as tx:
            await keys.set_bootstrap(tx, text_)
            await tx.flush()
            assert await keys.count_admins(tx) == int(works)
    for text_ in ("a" * 40, "b" * 40):
        with pytest.raises(UnauthorizedError):
            await keys.authenticate(database, text_)
    async with database.write() as tx:
        await keys.set_bootstrap(tx, "a" * 40)
    assert (await keys.authenticate(database, "a" * 40)).id == BOOTSTRAP_KEY_ID


async def open_as(database, user, key, *, is_admin=False):
    return await sessions.open_session(
        database, user_uuid=user.uuid, name="robot", key_id=key.id, is_admin=is_admin
    )


async def test_epoch_rises_with_every_opening(database):
    user, key = await add_user(database), await add_key(database)
    assert [await open_as(database, user, key) for _ in range(3)] == [1, 2, 3]


async def test_concurrent_openings_get_different_epochs(database):
    user, key = await add_user(database), await add_key(database)
    epochs = await asyncio.gather(*(open_as(database, user, key) for _ in range(8)))
    assert sorted(epochs) == list(range(1, 9))


async def test_only_the_same_key_or_an_admin_takes_a_name_over(database):
    user = await add_user(database)
    owner, other, admin = [await add_key(database) for _ in range(3)]
    await open_as(database, user, owner)
    with pytest.raises(ForbiddenError):
        await open_as(database, user, other)
    assert await open_as(database, user, admin, is_admin=True) == 2
    assert await open_as(database, user, owner) == 3  # an admin's visit does not cost the name
    async with database.write() as tx:
        await keys.revoke(tx, owner.id, actor=None)
    assert await open_as(database, user, other) == 4


async def test_discarded_name_begins_anew_unless_somebody_took_it(database):
    user, key = await add_user(database), await add_key(database)
    first = await open_as(database, user, key)
    second = await open_as(database, user, key)
    name = {"user_uuid": user.uuid, "name": "robot"}
    await sessions.discard_session(database, **name, epoch=first)
    assert await open_as(database, user, key) == second + 1
    await sessions.discard_session(database, **name, epoch=second + 1)
    assert await open_as(database, user, key) == 1


async def test_stream_of_a_user_who_was_just_erased_cannot_open(database):
    user, key = await add_user(database), await add_key(database)
    async with database.write() as tx:
        await users.erase(tx, "ada", actor=None, audit_key=AUDIT_KEY)
    with pytest.raises(UserDeletedError):
        await open_as(database, user, key)


async def test_watch_tells_who_must_go_and_why(database):
    ada, bob = await add_user(database, "ada"), await add_user(database, "bob")
    good, bad = await add_key(database), await add_key(database)
    streams = {}
    for name, user, key in (
        ("good", ada, good),
        ("fenced", ada, good),
        ("revoked", ada, bad),
        ("deleted", bob, good),
    ):
        epoch = await sessions.open_session(
            database, user_uuid=user.uuid, name=name, key_id=key.id, is_admin=False
        )
        streams[name] = OpenStream(user.uuid, key.id, name, epoch)
    assert await sessions.watch(database, list(streams.values())) == {}

    await sessions.open_session(
        database, user_uuid=ada.uuid, name="fenced", key_id=good.id, is_admin=False
    )
    async with database.write() as tx:
        await keys.revoke(tx, bad.id, actor=None)
        await users.erase(tx, "bob", actor=None, audit_key=AUDIT_KEY)
    assert await sessions.watch(database, list(streams.values())) == {
        streams["fenced"]: Verdict.FENCED,
        streams["revoked"]: Verdict.KEY_REVOKED,
        streams["deleted"]: Verdict.USER_DELETED,
    }
    assert await sessions.watch(database, []) == {}


async def test_two_writers_that_read_first_both_get_through(database):
    """Without BEGIN IMMEDIATE the second one fails at once, whatever the timeout."""

    async def write(name):
        async with database.write() as tx:
            await tx.scalar(select(func.count()).select_from(AuditRow))
            await asyncio.sleep(0.05)
            audit.record(tx, Action.USER_CREATED, actor=None, subject=name)

    await asyncio.gather(*(write(str(i)) for i in range(4)))
    assert (await count_rows(database))["audit"] == 4


async def write_while_reading(database):
    async with database.read() as tx:
        audit.record(tx, Action.USER_CREATED, actor=None)
        await tx.flush()


async def test_reading_stores_nothing(database):
    if database.is_sqlite:
        await write_while_reading(database)
    else:
        with pytest.raises(NotReadyError) as caught:
            await write_while_reading(database)
        assert isinstance(caught.value.__cause__, InternalError)
        assert "read-only" in str(caught.value.__cause__)
    assert (await count_rows(database))["audit"] == 0


async def test_a_database_that_lost_a_table_is_not_ready_rather_than_a_crash(database):
    """So that whatever watches the database in the background lives on."""
    with pytest.raises(NotReadyError):
        async with database.read() as tx:
            await tx.execute(text("select * from nowhere"))


async def test_an_id_that_cannot_be_is_nobody(database):
    for impossible in ("a\x00b", "\ud800", "a/b", ""):
        with pytest.raises(UnknownUserError):
            async with database.read() as tx:
                await users.get(tx, impossible)


async def test_sqlite_is_set_up_for_many_readers_and_for_erasure(tmp_path):
    database = Database(find_database(make_settings(tmp_path / "data")))
    async with database.read() as tx:
        found = [
            await tx.scalar(text(f"PRAGMA {name}"))
            for name in ("journal_mode", "synchronous", "foreign_keys", "secure_delete")
        ]
    await database.close()
    assert found == ["wal", 2, 1, 1]
    assert (tmp_path / "data").stat().st_mode & 0o077 == 0  # the data are personal


async def test_unreachable_database_is_not_ready(tmp_path):
    url = "postgresql://nobody@127.0.0.1:1/none"
    database = Database(find_database(make_settings(tmp_path, database_url=url)), timeout_s=1.0)
    with pytest.raises(NotReadyError):
        await database.ping()
    await database.close()


async def test_exhausted_pool_is_not_ready(tmp_path):
    database = Database(find_database(make_settings(tmp_path)), pool=1, timeout_s=0.2)
    async with database.read() as tx:
        await tx.execute(text("SELECT 1"))
        with pytest.raises(NotReadyError):
            await database.ping()
    await database.close()
