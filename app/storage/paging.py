"""One page of a list, newest first."""

from typing import Any, TypeVarTuple

from sqlalchemy import Select, tuple_
from sqlalchemy.orm import InstrumentedAttribute

from app.domain.pagination import Cursor

Columns = TypeVarTuple("Columns")


def page_query(
    query: Select[*Columns],
    *,
    order: tuple[InstrumentedAttribute[Any], InstrumentedAttribute[Any]],
    after: Cursor | None,
    limit: int,
) -> Select[*Columns]:
    """Restrict a query to one page, and one row more, which tells whether the list goes on.

    Args:
        query: what is listed.
        order: the columns of the instant and of the id of a row.
        after: where the page before ended.
        limit: rows of a page.
    """
    if after is not None:
        query = query.where(tuple_(*order) < tuple_(after.created_at, after.id))
    return query.order_by(*(column.desc() for column in order)).limit(limit + 1)
