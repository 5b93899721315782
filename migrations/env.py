"""How Alembic reaches the database, from the service or from its own command line."""

import asyncio
from typing import Literal

from alembic import context
from alembic.autogenerate.api import AutogenContext
from sqlalchemy import Connection, TypeDecorator

from app.settings import load_settings
from app.storage.database import Database
from app.storage.tables import Base


def render_plain(kind: str, item: object, _: AutogenContext) -> str | Literal[False]:
    """Write a column type of ours as what it is stored as: migrations outlive the code."""
    if kind == "type" and isinstance(item, TypeDecorator):
        return f"sa.{item.impl_instance!r}"
    return False


def migrate(connection: Connection) -> None:
    """Run the migrations on a connection whose transaction the caller ends."""
    context.configure(
        connection=connection,
        target_metadata=Base.metadata,
        render_as_batch=True,  # SQLite cannot change a column in place
        render_item=render_plain,
        transactional_ddl=True,
    )
    with context.begin_transaction():
        context.run_migrations()


async def connect_and_migrate() -> None:
    """Connect as the service would, and run the migrations."""
    database = Database.from_settings(load_settings())
    try:
        async with database.write() as session:
            await (await session.connection()).run_sync(migrate)
    finally:
        await database.close()


given = context.config.attributes.get("connection")
if given is None:
    asyncio.run(connect_and_migrate())
else:
    migrate(given)
