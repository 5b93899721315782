"""The one statement that SQLite and PostgreSQL share and SQLAlchemy has twice."""

from collections.abc import Mapping, Sequence
from typing import Any

from sqlalchemy import TextClause
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.ext.asyncio import AsyncSession
from sqlalchemy.orm import DeclarativeBase


async def upsert(
    tx: AsyncSession,
    table: type[DeclarativeBase],
    row: Mapping[str, Any],
    *,
    on: Sequence[str],
    change: Mapping[str, Any],
    where: TextClause | None = None,
    returning: str | None = None,
) -> Any:  # noqa: ANN401 - the type of whichever column is asked for
    """Insert a row, or change the one that is in its way.

    Args:
        tx: a transaction for writing.
        table: where.
        row: its values.
        on: columns of the unique index that may be in the way.
        change: what to set on the row that is there.
        where: condition of that index, where it is a partial one.
        returning: a column of the row to give back.
    """
    insert = sqlite.insert if tx.get_bind().dialect.name == "sqlite" else postgresql.insert
    statement: Any = insert(table).values(dict(row))
    statement = statement.on_conflict_do_update(
        index_elements=list(on), index_where=where, set_=dict(change)
    )
    if returning is None:
        return await tx.execute(statement)
    return await tx.scalar(statement.returning(getattr(table, returning)))
