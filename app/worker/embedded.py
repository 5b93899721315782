"""The worker that a service brings along: a process of its own, started again when it dies."""

import asyncio
import sys
from asyncio.subprocess import PIPE, Process
from contextlib import suppress
from pathlib import Path

import structlog

STOP_S = 5.0
FIRST_PAUSE_S, LONGEST_PAUSE_S = 1.0, 60.0
STEADY_S = 60.0
"""A worker that lived this long did not die of its start."""

log = structlog.get_logger(__name__)


class EmbeddedWorker:
    """Keeps one worker process alive between `start` and `stop`.

    The process ends with the service, however that ends: it notices when the pipe to it closes.

    Args:
        data_dir: folder of the SQLite database.
    """

    def __init__(self, data_dir: Path) -> None:
        self._data_dir = data_dir
        self._task: asyncio.Task[None] | None = None
        self._process: Process | None = None

    @property
    def process_id(self) -> int | None:
        """The process as it is now, None between two."""
        return None if self._process is None else self._process.pid

    def start(self) -> None:
        """Start the worker, and from then on see to it that there is one."""
        self._task = asyncio.create_task(self._keep())

    async def stop(self) -> None:
        """Let the worker give its job back, and end it."""
        if self._task is None:
            return
        self._task.cancel()
        with suppress(asyncio.CancelledError):
            await self._task
        self._task = None

    async def _keep(self) -> None:
        pause_s = FIRST_PAUSE_S
        loop = asyncio.get_running_loop()
        while True:
            began = loop.time()
            status = await self._run_one()
            if loop.time() - began > STEADY_S:
                pause_s = FIRST_PAUSE_S
            log.error("the worker ended", status=status, again_in_s=pause_s)
            await asyncio.sleep(pause_s)
            pause_s = min(2 * pause_s, LONGEST_PAUSE_S)

    async def _run_one(self) -> int:
        process = await asyncio.create_subprocess_exec(
            sys.executable,
            "-m",
            "app.cli",
            "worker",
            "--tied",
            "--data-dir",
            str(self._data_dir),
            stdin=PIPE,
            start_new_session=True,  # Ctrl+C is for the service, which ends this process itself
        )
        self._process = process
        try:
            return await process.wait()
        finally:
            await _end(process)
            self._process = None


async def _end(process: Process) -> None:
    if process.returncode is not None:
        return
    process.terminate()
    try:
        await asyncio.wait_for(process.wait(), STOP_S)
    except TimeoutError:
        process.kill()
        await process.wait()
