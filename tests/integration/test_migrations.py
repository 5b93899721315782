import pytest
from alembic import command
from sqlalchemy import select, text

from app.domain.errors import MigrationError, StartError
from app.storage import migrate
from app.storage.database import Database, find_database
from app.storage.tables import Base, UserRow
from tests.support import make_settings, postgres_schema

pytestmark = pytest.mark.asyncio


@pytest.fixture
def other_settings(settings, request, tmp_path):
    """A second empty database of the same kind."""
    if settings.database_url is None:
        yield make_settings(tmp_path / "other")
    else:
        with postgres_schema(request.getfixturevalue("postgres_url")) as url:
            yield make_settings(tmp_path, database_url=url)


async def test_migrations_give_the_tables_of_the_code(settings, other_settings):
    migrated, created = Database.from_settings(settings), Database.from_settings(other_settings)
    await migrate.upgrade(migrated)
    await migrate.create_tables(created)
    await migrate.compare_tables(migrated, created)
    assert set(await migrate.describe_tables(migrated)) == set(Base.metadata.tables)
    await migrated.close()
    await created.close()


async def test_second_upgrade_has_nothing_to_do(settings):
    database = Database.from_settings(settings)
    with pytest.raises(MigrationError, match="kinecast db upgrade"):
        await migrate.check_current(database)
    assert await migrate.upgrade(database)
    assert not await migrate.upgrade(database)
    await migrate.check_current(database)
    await database.close()


@pytest.mark.parametrize(
    "change",
    [
        "ALTER TABLE users ADD COLUMN more TEXT",
        "DROP INDEX ix_users_created_at_uuid",
        "CREATE TABLE extra (a INTEGER)",
    ],
)
async def test_any_difference_is_noticed(tmp_path, change):
    migrated = Database(find_database(make_settings(tmp_path / "a")))
    created = Database(find_database(make_settings(tmp_path / "b")))
    await migrate.create_tables(created)
    await migrate.upgrade(migrated)
    async with migrated.write() as tx:
        await tx.execute(text(change))
    with pytest.raises(MigrationError, match="differ"):
        await migrate.compare_tables(migrated, created)
    await migrated.close()
    await created.close()


async def test_database_of_a_newer_version_is_refused(tmp_path):
    database = Database(find_database(make_settings(tmp_path)))
    await migrate.upgrade(database)
    async with database.write() as tx:
        await tx.execute(text("UPDATE alembic_version SET version_num = '9999'"))
    with pytest.raises(MigrationError):
        await migrate.check_current(database)
    with pytest.raises(MigrationError):
        await migrate.upgrade(database)
    await database.close()


async def test_check_passes_and_there_is_one_newest_migration():
    await migrate.check_migrations()
    assert migrate.find_head()


@pytest.mark.parametrize("url", ["nonsense", "mysql://a@b/c"])
async def test_other_databases_are_refused(tmp_path, url):
    with pytest.raises(StartError, match="KINECAST_DATABASE_URL"):
        find_database(make_settings(tmp_path, database_url=url))


async def test_filled_database_of_the_first_version_keeps_its_users(settings):
    database = Database.from_settings(settings)
    async with database.write() as session:
        await migrate._run(
            session,
            lambda connection: command.upgrade(migrate.alembic_config(connection), "0001"),
        )
        await session.execute(
            text(
                "INSERT INTO users (uuid, id, skeleton, up, root_relative, created_at) VALUES "
                "('00000000000000000000000000000001', 'ada', 'kinect_v1', 'y', FALSE,"
                " '2026-01-01 00:00:00.000000')"
            )
        )
    assert await migrate.upgrade(database)
    async with database.read() as tx:
        ada = (await tx.scalars(select(UserRow))).one()
    assert (ada.id, ada.auto_promote, ada.last_version, ada.served_at) == ("ada", True, 0, None)
    await database.close()
