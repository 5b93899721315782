"""What a database refuses, as against one that is away; and how soon that is noticed."""

import pytest
from sqlalchemy import text
from sqlalchemy.engine import make_url

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


async def read_options(database):
    """Read how the connection was made."""
    async with database.read() as tx:
        raw = await (await tx.connection()).get_raw_connection()
        return raw.driver_connection.info.get_parameters()


async def test_a_connection_that_is_dead_is_noticed_within_seconds(postgres):
    options = await read_options(postgres)
    await postgres.close()
    assert options["keepalives"] == "1"
    idle, interval, count = (
        int(options[f"keepalives_{name}"]) for name in ("idle", "interval", "count")
    )
    assert idle + interval * count <= 15
    assert 1_000 <= int(options["tcp_user_timeout"]) <= 15_000


async def test_what_the_address_says_of_the_connection_counts(postgres_url, tmp_path):
    own = make_url(postgres_url).update_query_dict({"keepalives_idle": "60"})
    address = own.render_as_string(hide_password=False)
    database = Database.from_settings(make_settings(tmp_path, database_url=address))
    assert (await read_options(database))["keepalives_idle"] == "60"
    await database.close()
