"""The training process: niced, capped, and gone as soon as its worker is."""

import importlib
import os
import sys
import threading
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from time import monotonic
from typing import Any, BinaryIO

from app.personalize.run import Trainer, run_task
from app.worker.messages import Done, Failed, Progress, pack, read_start

TELL_EVERY_S = 0.25
AUTOGROUP = Path("/proc/self/autogroup")
ORPHANED = 3
"""Exit status of a process whose worker is gone."""


def main() -> None:
    """Read the task, run it, tell how far it is, and tell its end."""
    step_back(int(sys.argv[1]))
    receive, send = sys.stdin.buffer, sys.stdout.buffer
    sys.stdout = sys.stderr  # whatever a library prints must not get between the messages
    start = read_start(receive)
    threading.Thread(target=_leave_with_the_worker, args=(receive.fileno(),), daemon=True).start()
    tell = _Teller(send)
    try:
        outcome = run_task(start.task, find_trainer(start.trainer), tell)
    except (ValueError, RuntimeError, MemoryError, OSError) as error:
        _send(send, pack(Failed(f"{type(error).__name__}: {error}"[:2000])))
        return
    _send(send, pack(Done(outcome)))


def find_trainer(path: str) -> Trainer:
    """Import a trainer by `module:function`."""
    module, _, name = path.partition(":")
    trainer: Trainer = getattr(importlib.import_module(module), name)
    return trainer


def step_back(nice: int) -> None:
    """Let forecasting go first, by niceness.

    Where Linux shares the processor among sessions first (its autogroups, see sched(7)), niceness
    counts within a session alone, and a training process, which has one of its own, would get as
    much as the service however nice it is: so the session steps back as well.
    """
    os.nice(nice)
    if os.getsid(0) == os.getpid():
        with suppress(OSError):
            AUTOGROUP.write_text(str(nice))


class _Teller:
    """Passes progress on, but not more often than anybody looks."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._told = 0.0

    def __call__(self, values: Mapping[str, Any]) -> None:
        if monotonic() - self._told >= TELL_EVERY_S:
            self._told = monotonic()
            _send(self._stream, pack(Progress(dict(values))))


def _send(stream: BinaryIO, message: bytes) -> None:
    stream.write(message)
    stream.flush()


def _leave_with_the_worker(pipe: int) -> None:
    """End this process when the pipe closes: nobody would read the result."""
    os.read(pipe, 1)  # past Python's buffer, whose lock would be in the way of a normal end
    os._exit(ORPHANED)


if __name__ == "__main__":
    main()
