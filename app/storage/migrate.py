"""Bringing a database to the tables of this version, and checking that it has them."""

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from alembic import command
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import Connection, inspect
from sqlalchemy.engine import URL
from sqlalchemy.ext.asyncio import AsyncSession

import migrations
from app.domain.errors import MigrationError
from app.storage.database import Database
from app.storage.tables import Base

Description = dict[str, dict[str, Any]]
Result = TypeVar("Result")


def alembic_config(connection: Connection | None = None) -> Config:
    """Point Alembic at the scripts that came with the package."""
    config = Config()
    folder = Path(migrations.__file__).parent
    config.set_main_option("script_location", str(folder).replace("%", "%%"))
    config.attributes["connection"] = connection
    return config


def find_head() -> str:
    """Name the newest migration.

    Raises:
        MigrationError: there is none, or there are two newest ones.
    """
    heads = ScriptDirectory.from_config(alembic_config()).get_heads()
    if len(heads) != 1:
        raise MigrationError(f"There must be one newest migration, not {len(heads)}: {heads}.")
    return heads[0]


def find_all() -> set[str]:
    """Name every migration that this version knows."""
    scripts = ScriptDirectory.from_config(alembic_config()).walk_revisions()
    return {script.revision for script in scripts}


async def upgrade(database: Database) -> bool:
    """Bring the tables up to date, in one transaction; tell whether anything was to do.

    Raises:
        MigrationError: the database was used with a newer version.
    """
    head = find_head()
    async with database.lock("kinecast.migrate") as session:
        before = await _run(session, _read_revision)
        if before == head:
            return False
        if before not in {None, *find_all()}:
            raise MigrationError(
                f"The database is at migration {before}, which this version does not know: it was "
                "used with a newer version of Kinecast."
            )
        await _run(session, lambda connection: command.upgrade(alembic_config(connection), "head"))
        return True


async def check_current(database: Database) -> None:
    """Make sure that the database has the tables of this version.

    Raises:
        MigrationError: it has older or newer ones, or none.
    """
    async with database.read() as session:
        revision = await _run(session, _read_revision)
    if revision != find_head():
        raise MigrationError(
            f"The database is at migration {revision or 'none'}, this version needs "
            f"{find_head()}. Run: kinecast db upgrade"
        )


async def check_migrations() -> None:
    """Make sure that the migrations give exactly the tables of the code, in SQLite.

    Raises:
        MigrationError: they differ, or the migrations have more than one end.
    """
    with tempfile.TemporaryDirectory() as folder:
        migrated = Database(_sqlite(Path(folder) / "migrated"))
        created = Database(_sqlite(Path(folder) / "created"))
        try:
            await upgrade(migrated)
            await create_tables(created)
            await compare_tables(migrated, created)
        finally:
            await migrated.close()
            await created.close()


async def create_tables(database: Database) -> None:
    """Create the tables straight from the code, to compare with."""
    async with database.write() as session:
        await _run(session, Base.metadata.create_all)


async def compare_tables(migrated: Database, created: Database) -> None:
    """Refuse two databases whose tables differ in anything.

    Raises:
        MigrationError: naming the tables that differ.
    """
    found, wanted = await describe_tables(migrated), await describe_tables(created)
    different = sorted(
        name for name in found.keys() | wanted.keys() if found.get(name) != wanted.get(name)
    )
    if different:
        raise MigrationError(
            f"The migrations do not give the tables of the code: {', '.join(different)} differ. "
            "Run: alembic revision --autogenerate"
        )


async def describe_tables(database: Database) -> Description:
    """Describe every table: columns, keys, indexes and checks, with their names."""
    async with database.read() as session:
        return await _run(session, _describe)


async def _run(session: AsyncSession, function: Callable[[Connection], Result]) -> Result:
    connection = await session.connection()
    return await connection.run_sync(function)


def _read_revision(connection: Connection) -> str | None:
    return MigrationContext.configure(connection).get_current_revision()


def _describe(connection: Connection) -> Description:
    inspector = inspect(connection)
    return {
        table: {
            "columns": [
                (c["name"], str(c["type"]), c["nullable"], c["default"])
                for c in inspector.get_columns(table)
            ],
            "primary": inspector.get_pk_constraint(table),
            "foreign": _by_name(inspector.get_foreign_keys(table)),
            "unique": _by_name(inspector.get_unique_constraints(table)),
            "checks": _by_name(inspector.get_check_constraints(table)),
            "indexes": _by_name(_write_conditions(inspector.get_indexes(table))),
        }
        for table in inspector.get_table_names()
        if table != "alembic_version"
    }


def _write_conditions(indexes: Any) -> list[Any]:  # noqa: ANN401 - as below
    """Write the condition of a partial index as text: as an object it equals only itself."""
    return [
        {**index, "dialect_options": {k: str(v) for k, v in index["dialect_options"].items()}}
        for index in indexes
    ]


def _by_name(constraints: Any) -> list[Any]:  # noqa: ANN401 - SQLAlchemy's many kinds of dict
    return sorted(constraints, key=lambda constraint: str(constraint["name"]))


def _sqlite(path: Path) -> URL:
    return URL.create("sqlite+aiosqlite", database=str(path))
