from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest
import pytest_asyncio

from app.settings import Settings
from app.storage.database import Database
from tests.support import (
    POSTGRES_VARIABLE,
    Service,
    find_postgres,
    make_settings,
    open_database,
    postgres_schema,
    run_service,
)


@pytest.fixture(scope="session")
def postgres_url() -> str:
    url = find_postgres()
    if url is None:
        pytest.skip(f"no PostgreSQL answers; set {POSTGRES_VARIABLE} to one that may be written to")
    return url


@pytest.fixture
def sqlite_settings(tmp_path: Path) -> Settings:
    return make_settings(tmp_path)


@pytest.fixture(params=["sqlite", "postgresql"])
def settings(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Settings]:
    """Settings of an empty database of each kind."""
    if request.param == "sqlite":
        yield make_settings(tmp_path)
        return
    with postgres_schema(request.getfixturevalue("postgres_url")) as url:
        yield make_settings(tmp_path, database_url=url)


@pytest_asyncio.fixture
async def database(settings: Settings) -> AsyncIterator[Database]:
    """A database with its tables, of each kind."""
    async with open_database(settings) as opened:
        yield opened


@pytest_asyncio.fixture
async def sqlite_database(sqlite_settings: Settings) -> AsyncIterator[Database]:
    """A database for what is the same with each kind, and slow."""
    async with open_database(sqlite_settings) as opened:
        yield opened


@pytest_asyncio.fixture
async def sqlite_service(sqlite_settings: Settings) -> AsyncIterator[Service]:
    """A service for what is the same with each kind of database, and slow."""
    async with run_service(sqlite_settings) as running:
        yield running


@pytest_asyncio.fixture
async def service(settings: Settings) -> AsyncIterator[Service]:
    """A service on each kind of database."""
    async with run_service(settings) as running:
        yield running
