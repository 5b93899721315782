"""A database that goes away and comes back: a real one, cut off."""

import asyncio
import sqlite3
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress

from sqlalchemy.engine import make_url

from app.settings import Settings
from app.storage.database import find_database


class Wire:
    """A line to PostgreSQL that can be cut: nothing passes, and nobody gets through."""

    def __init__(self, host: str, port: int) -> None:
        self.port = 0
        self._target = (host, port)
        self._is_cut = False
        self._writers: set[asyncio.StreamWriter] = set()
        self._loop = asyncio.new_event_loop()
        self._ready = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        assert self._ready.wait(5)

    @contextmanager
    def cut(self) -> Iterator[None]:
        self._loop.call_soon_threadsafe(self._sever)
        yield
        self._is_cut = False

    def close(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(5)

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        server = self._loop.run_until_complete(asyncio.start_server(self._join, "127.0.0.1", 0))
        self.port = server.sockets[0].getsockname()[1]
        self._ready.set()
        self._loop.run_forever()
        server.close()
        self._sever()
        tasks = asyncio.all_tasks(self._loop)
        for task in tasks:
            task.cancel()
        self._loop.run_until_complete(asyncio.gather(*tasks, return_exceptions=True))
        self._loop.close()

    def _sever(self) -> None:
        self._is_cut = True
        for writer in self._writers:
            writer.transport.abort()
        self._writers.clear()

    async def _join(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self._is_cut:
            writer.transport.abort()
            return
        there_reader, there = await asyncio.open_connection(*self._target)
        self._writers |= {writer, there}
        with suppress(OSError):
            await asyncio.gather(_pump(reader, there), _pump(there_reader, writer))


async def _pump(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    while data := await reader.read(65_536):
        writer.write(data)
        await writer.drain()
    writer.close()


@contextmanager
def cuttable(settings: Settings) -> Iterator[tuple[Settings, AbstractContextManager[None]]]:
    """Settings of the same database, and a block in which nothing can be stored in it."""
    url = find_database(settings)
    if settings.database_url is None:
        yield settings.model_copy(update={"database_timeout_s": 1.0}), _lock(str(url.database))
        return
    wire = Wire(url.host or "127.0.0.1", url.port or 5432)
    own = make_url(settings.database_url).set(host="127.0.0.1", port=wire.port)
    address = own.render_as_string(hide_password=False)
    try:
        yield settings.model_copy(update={"database_url": address}), wire.cut()
    finally:
        wire.close()


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
