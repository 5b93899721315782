"""A line between a client and a server that a test can slow down, stall and cut."""

import asyncio
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress


class Wire:
    """Forwards TCP connections to a port, of this machine if no other host is named.

    Attributes:
        port: where it listens.
        host, target: where it leads; the port may change, as when a server starts again elsewhere.
        delay_s: how long everything takes in each direction.
        is_stalled: whether nothing gets through, though nothing is closed.
        cut_after: bytes towards the client after which the connection is cut; None for never.
        is_away: whether nobody gets a connection.
        opened: how many connections there were.
    """

    def __init__(self, target: int, host: str = "127.0.0.1") -> None:
        self.port, self.target, self.host = 0, target, host
        self.delay_s = 0.0
        self.is_stalled = self.is_away = False
        self.cut_after: int | None = None
        self.opened = 0
        self._writers: set[asyncio.StreamWriter] = set()
        self._loop = asyncio.new_event_loop()
        self._ready = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        assert self._ready.wait(5)

    def cut(self) -> None:
        """Break every connection, without a word."""
        self._loop.call_soon_threadsafe(self._sever)

    def break_off(self) -> None:
        """Break every connection, and let no new one through until it is mended."""
        self.is_away = True
        self.cut()

    def mend(self) -> None:
        self.is_away = False

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
        self._loop.run_until_complete(asyncio.sleep(0))
        self._loop.close()

    def _sever(self) -> None:
        for writer in self._writers:
            writer.transport.abort()
        self._writers.clear()

    async def _join(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.opened += 1
        if self.is_away:
            writer.transport.abort()
            return
        try:
            there_reader, there = await asyncio.open_connection(self.host, self.target)
        except OSError:
            writer.transport.abort()
            return
        self._writers |= {writer, there}
        with suppress(OSError):
            await asyncio.gather(
                self._pump(reader, there, None), self._pump(there_reader, writer, self.cut_after)
            )

    async def _pump(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, most: int | None
    ) -> None:
        passed = 0
        while data := await reader.read(65_536):
            while self.is_stalled:  # noqa: ASYNC110 - it is set by another thread
                await asyncio.sleep(0.01)
            await asyncio.sleep(self.delay_s)
            if most is not None and passed + len(data) > most:
                writer.write(data[: most - passed])
                with suppress(OSError):
                    await writer.drain()
                self._sever()
                return
            passed += len(data)
            writer.write(data)
            await writer.drain()
        writer.close()


@contextmanager
def open_wire(target: int, host: str = "127.0.0.1") -> Iterator[Wire]:
    wire = Wire(target, host)
    try:
        yield wire
    finally:
        wire.close()
