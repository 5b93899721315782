"""What a database refuses, as against one that is away."""

import pytest
from sqlalchemy import text

from app.domain.errors import InternalError
from app.storage.database import Database
from tests.support import make_settings

pytestmark = pytest.mark.asyncio


@pytest.fixture
def postgres(postgres_url, tmp_path):
    return Database.from_settings(make_settings(tmp_path, database_url=postgres_url))


@pytest.mark.parametrize(
    "statement",
    ["select cast('x' as integer)", "select 1 / 0", "selekt 1", "select cast('NaN' as json)"],
)
async def test_a_statement_that_never_succeeds_is_no_outage(postgres, statement):
    """So that whoever repeats a step until there is a database does not do so for ever."""
    with pytest.raises(InternalError, match="refuses"):
        async with postgres.read() as tx:
            await tx.execute(text(statement))
    await postgres.close()
