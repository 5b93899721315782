"""Connections and transactions; the only place that commits.

One transaction per request or step, never one held open while something else is awaited for long.
SQLite gives one writer at a time: a write transaction says so at its beginning, because one that
reads first and then writes fails at once, whatever the timeout, when another wrote in between.
"""

import asyncio
import time
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from threading import Thread
from typing import Any
from weakref import WeakSet

import structlog
from sqlalchemy import Connection, event, text
from sqlalchemy.engine import URL, make_url
from sqlalchemy.exc import (
    ArgumentError,
    DataError,
    DBAPIError,
    IntegrityError,
    InterfaceError,
    OperationalError,
    ProgrammingError,
)
from sqlalchemy.exc import TimeoutError as PoolTimeoutError
from sqlalchemy.ext.asyncio import AsyncEngine, AsyncSession, create_async_engine

from app.domain.errors import InternalError, NotReadyError, StartError
from app.settings import Settings
from app.storage.announcements import Announcements, read_announced

SQLITE_FILE = "kinecast.sqlite3"
LAST_S = 1.0
"""Longest wait, when the pool is closed, for statements that were called off."""
_WRITE = "kinecast_write"
_DRIVERS = {
    "postgresql": "postgresql+psycopg",
    "postgres": "postgresql+psycopg",
    "postgresql+psycopg": "postgresql+psycopg",
    "sqlite": "sqlite+aiosqlite",
    "sqlite+aiosqlite": "sqlite+aiosqlite",
}
_UNREACHABLE = (OperationalError, InterfaceError, PoolTimeoutError)
_MENDABLE = frozenset({"3F000", "42501", "42703", "42P01"})
"""What PostgreSQL calls a schema, right, column or table that is not there: yet, or any more."""

log = structlog.get_logger(__name__)


def find_database(settings: Settings) -> URL:
    """Tell where the data is: at the given address, or in a SQLite file of the data folder.

    Raises:
        StartError: the address is none, or of another kind of database.
    """
    if settings.database_url is None:
        return URL.create("sqlite+aiosqlite", database=str(settings.data_dir / SQLITE_FILE))
    try:
        url = make_url(settings.database_url)
    except ArgumentError:
        raise StartError("KINECAST_DATABASE_URL is not the address of a database.") from None
    if url.drivername not in _DRIVERS:
        raise StartError(f"KINECAST_DATABASE_URL: no support for {url.drivername}.")
    return url.set(drivername=_DRIVERS[url.drivername])


class Database:
    """The pool of connections to one database.

    Args:
        url: where it is, as ``find_database`` gives it.
        pool: most open connections.
        timeout_s: longest wait for a connection or for another writer.
        announcements: told what a transaction announced once it is stored; by default it stays
            in this process.
    """

    def __init__(
        self,
        url: URL,
        *,
        pool: int = 5,
        timeout_s: float = 5.0,
        announcements: Announcements | None = None,
    ) -> None:
        self.url = url
        self.announcements = announcements or Announcements()
        self._threads: WeakSet[Thread] = WeakSet()
        self.is_sqlite = url.get_backend_name() == "sqlite"
        options: dict[str, Any] = {"pool_size": pool, "max_overflow": 0, "pool_timeout": timeout_s}
        if self.is_sqlite:
            self._make_folder()
        else:
            options |= {"pool_pre_ping": True, "connect_args": _postgres_options(url, timeout_s)}
        self._engine = create_async_engine(url, **options)
        if self.is_sqlite:
            _control_transactions(self._engine, timeout_s=timeout_s)
            _note_threads(self._engine, self._threads)
        self._readers = self._engine.execution_options(postgresql_readonly=not self.is_sqlite)
        self._writers = self._engine.execution_options(**{_WRITE: True})

    @classmethod
    def from_settings(cls, settings: Settings) -> "Database":
        """Make the pool that the settings describe; connects to nothing yet."""
        return cls(
            find_database(settings),
            pool=settings.database_pool,
            timeout_s=settings.database_timeout_s,
            announcements=Announcements(settings.redis_url),
        )

    @asynccontextmanager
    async def read(self) -> AsyncIterator[AsyncSession]:
        """Open a transaction for reading; nothing of it is ever stored.

        In SQLite all of it sees one moment; in PostgreSQL each statement sees its own.

        Raises:
            NotReadyError: the database cannot be reached, or every connection is in use.
            InternalError: it refuses a statement, and always would.
        """
        async with _translate_outage(), AsyncSession(self._readers) as session:
            yield session

    @asynccontextmanager
    async def write(self) -> AsyncIterator[AsyncSession]:
        """Open a transaction for writing: stored at the end of the block, or not at all.

        Raises:
            NotReadyError: the database cannot be reached, or another writer takes too long.
            InternalError: it refuses a statement, and always would.
        """
        async with (
            _translate_outage(),
            AsyncSession(self._writers, expire_on_commit=False) as session,
            session.begin(),
        ):
            yield session
        self.announcements.tell(read_announced(session))

    @asynccontextmanager
    async def lock(self, name: str) -> AsyncIterator[AsyncSession]:
        """Open a write transaction that no other of the same name overlaps, on any replica."""
        async with self.write() as session:
            if not self.is_sqlite:  # where a write transaction is already the only one
                statement = text("SELECT pg_advisory_xact_lock(hashtext(:name))")
                await session.execute(statement, {"name": name})
            yield session

    async def ping(self) -> None:
        """Ask the database for a sign of life.

        Raises:
            NotReadyError: it gave none.
        """
        async with self.read() as session:
            await session.execute(text("SELECT 1"))

    async def forget_erased(self) -> None:
        """Take what was erased out of SQLite's log file too, as far as no reader is in the way.

        PostgreSQL vacuums by itself.
        """
        if not self.is_sqlite:
            return
        async with _translate_outage(), self._engine.connect() as connection:
            driver = (await connection.get_raw_connection()).driver_connection
            if driver is not None:
                await (await driver.execute("PRAGMA wal_checkpoint(TRUNCATE)")).close()

    async def close(self) -> None:
        """Close every connection; one whose statement was called off may need a moment.

        Its thread hands a last result to this loop, which must not have ended by then.
        """
        await self.announcements.close()
        await self._engine.dispose()
        await asyncio.to_thread(_join, tuple(self._threads))

    def _make_folder(self) -> None:
        """Make the folder of the file, for nobody else to read: the data are personal."""
        if self.url.database:
            Path(self.url.database).parent.mkdir(parents=True, exist_ok=True, mode=0o700)


@asynccontextmanager
async def _translate_outage() -> AsyncIterator[None]:
    try:
        yield
    except IntegrityError:
        raise  # a broken promise of the caller's, not of the database
    except _UNREACHABLE as error:
        raise NotReadyError("The database cannot be reached.") from error
    except DBAPIError as error:
        if _is_hopeless(error):  # whoever took it for an outage would repeat it for ever
            kind = type(error.orig).__name__
            log.warning("the database refuses a statement", kind=kind, statement=error.statement)
            raise InternalError(f"The database refuses a statement ({kind}).") from error
        # damaged, half migrated, or not to be written to
        raise NotReadyError("The database cannot be used.") from error


def _is_hopeless(error: DBAPIError) -> bool:
    """Tell whether a statement is at fault, by its text or its values, rather than the database."""
    is_ours = isinstance(error, DataError | ProgrammingError) and not error.connection_invalidated
    return is_ours and getattr(error.orig, "sqlstate", None) not in _MENDABLE


def _postgres_options(url: URL, timeout_s: float) -> dict[str, Any]:
    """Name the connections, and notice within seconds that the other end is gone without a word.

    Left alone, the system waits for minutes for an answer, and for hours where none is due. What
    the address says itself counts.
    """
    options = {
        "connect_timeout": max(1, round(timeout_s)),
        "application_name": "kinecast",
        "keepalives": 1,
        "keepalives_idle": 5,
        "keepalives_interval": 2,
        "keepalives_count": 3,
        "tcp_user_timeout": 10_000,  # milliseconds
    }
    return {name: value for name, value in options.items() if name not in url.query}


def _note_threads(engine: AsyncEngine, threads: "WeakSet[Thread]") -> None:
    """Remember the threads in which SQLite's connections live."""

    @event.listens_for(engine.sync_engine, "connect")
    def note(connection: Any, record: object) -> None:  # noqa: ANN401 - SQLAlchemy's adapter
        del record
        threads.add(connection.driver_connection._thread)  # noqa: SLF001 - aiosqlite tells it nowhere


def _join(threads: Sequence[Thread]) -> None:
    """Wait for threads to end, all in all no longer than is bearable at the end of a program."""
    until = time.monotonic() + LAST_S
    for thread in threads:
        thread.join(max(0.0, until - time.monotonic()))


def _control_transactions(engine: AsyncEngine, *, timeout_s: float) -> None:
    """Begin transactions ourselves: left alone, Python's driver begins them late or never."""

    @event.listens_for(engine.sync_engine, "connect")
    def prepare(connection: Any, record: object) -> None:  # noqa: ANN401 - SQLAlchemy's adapter
        del record
        connection.isolation_level = None
        cursor = connection.cursor()
        cursor.execute(f"PRAGMA busy_timeout = {round(timeout_s * 1000)}")
        cursor.execute("PRAGMA journal_mode = WAL")
        cursor.execute("PRAGMA synchronous = FULL")  # an accepted trial outlives a power cut
        cursor.execute("PRAGMA foreign_keys = ON")
        cursor.execute("PRAGMA secure_delete = ON")  # what is erased must not stay in the file
        cursor.close()

    @event.listens_for(engine.sync_engine, "begin")
    def begin(connection: Connection) -> None:
        writes = connection.get_execution_options().get(_WRITE, False)
        connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")
