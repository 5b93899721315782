"""The worker's hold on a training process: started, listened to, and ended in any case."""

import asyncio
import sys
from asyncio.subprocess import PIPE, Process
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from typing import Self

from app.personalize.run import Task
from app.worker.messages import FromTrainer, Start, pack, read_reply

_LIMIT = 2**20


class Trainee:
    """A training process; use `start`."""

    def __init__(self, process: Process, task: bytes) -> None:
        if process.stdin is None or process.stdout is None:
            raise ValueError("a training process needs both pipes")
        self._process, self._stdin, self._stdout = process, process.stdin, process.stdout
        self._feeding = asyncio.create_task(self._feed(task))
        self._reading: asyncio.Task[FromTrainer | None] | None = None

    @classmethod
    @asynccontextmanager
    async def start(cls, task: Task, trainer: str, *, nice: int) -> AsyncIterator[Self]:
        """Start a fresh interpreter on a task; at the end of the block it is no more."""
        process = await asyncio.create_subprocess_exec(
            sys.executable,
            "-m",
            "app.worker.trainer",
            str(nice),
            stdin=PIPE,
            stdout=PIPE,
            limit=_LIMIT,
            start_new_session=True,  # Ctrl+C is for the worker, which ends this process itself
        )
        trainee = cls(process, pack(Start(task, trainer)))
        try:
            yield trainee
        finally:
            await trainee.end()

    async def wait(self, timeout_s: float) -> FromTrainer | str | None:
        """Wait for a message.

        Returns:
            The message; an error for people where the process ended without one; None where
            nothing came in time.
        """
        if self._reading is None:
            self._reading = asyncio.create_task(read_reply(self._stdout))
        done, _ = await asyncio.wait({self._reading}, timeout=timeout_s)
        if not done:
            return None
        reply, self._reading = self._reading.result(), None
        if reply is not None:
            return reply
        status = await self._process.wait()
        how = f"signal {-status}" if status < 0 else f"status {status}"
        return f"The training process ended with {how}."

    async def end(self) -> None:
        """End the process, whatever it is doing."""
        for task in (self._feeding, self._reading):
            if task is not None:
                task.cancel()
                with suppress(asyncio.CancelledError):
                    await task
        if self._process.returncode is None:
            self._process.kill()
        await self._process.wait()
        self._stdin.close()

    async def _feed(self, task: bytes) -> None:
        """Hand the task over; the pipe stays open, for the process ends with it."""
        with suppress(BrokenPipeError, ConnectionResetError):
            self._stdin.write(task)
            await self._stdin.drain()
