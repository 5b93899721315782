"""A database that goes away and comes back: a real one, cut off."""

import sqlite3
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager

from sqlalchemy.engine import make_url

from app.settings import Settings
from app.storage.database import find_database
from tests.wire import Wire, open_wire


@contextmanager
def cuttable(settings: Settings) -> Iterator[tuple[Settings, AbstractContextManager[None]]]:
    """Settings of the same database, and a block in which nothing can be stored in it."""
    url = find_database(settings)
    if settings.database_url is None:
        yield settings.model_copy(update={"database_timeout_s": 1.0}), _lock(str(url.database))
        return
    with open_wire(url.port or 5432, url.host or "127.0.0.1") as wire:
        own = make_url(settings.database_url).set(host="127.0.0.1", port=wire.port)
        address = own.render_as_string(hide_password=False)
        yield settings.model_copy(update={"database_url": address}), _broken(wire)


@contextmanager
def _broken(wire: Wire) -> Iterator[None]:
    wire.break_off()
    yield
    wire.mend()


@contextmanager
def _lock(path: str) -> Iterator[None]:
    """Keep every other writer out of a SQLite file."""
    connection = sqlite3.connect(path, isolation_level=None)
    connection.execute("BEGIN IMMEDIATE")
    try:
        yield
    finally:
        connection.execute("ROLLBACK")
        connection.close()
