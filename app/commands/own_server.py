"""A service of one's own, in a process of its own: for benchmarks and whole-flow checks."""

import re
import secrets
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from app.settings import make_environment

START_S = 60.0
STOP_S = 20.0
_READY = re.compile(r"ready at (http://\S+)")
_TAIL_CHARACTERS = 2000


class OwnServerError(RuntimeError):
    """The service does not start or does not stop; the message has the end of its log."""


@dataclass(frozen=True)
class OwnServer:
    """A running service.

    Attributes:
        url: where it listens.
        key: its admin key.
        process: the server itself.
        log: what it has written.
    """

    url: str
    key: str
    process: "subprocess.Popen[bytes]"
    log: Path

    def stop(self, timeout_s: float = STOP_S) -> int:
        """Ask it to stop and wait; gives its exit status.

        Raises:
            OwnServerError: it did not stop by itself; it was killed.
        """
        self.process.terminate()
        try:
            return self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
            raise OwnServerError(f"The service did not stop: {_read_tail(self.log)}") from None


@contextmanager
def run_own_server(
    folder: Path, *, start_s: float = START_S, key: str | None = None, **settings: object
) -> Iterator[OwnServer]:
    """Run a service on a free port of this machine until the block ends.

    Args:
        folder: for its database and its log.
        start_s: longest wait for it to be ready.
        key: its admin key; one is drawn by default.
        settings: of the service, as named in `app.settings`.

    Raises:
        OwnServerError: it does not start, or does not stop.
    """
    key = key or secrets.token_hex(24)
    log = folder / f"serve-{secrets.token_hex(4)}.log"
    given: dict[str, object] = {"data_dir": folder, "port": 0, "host": "127.0.0.1"}
    environment = make_environment(**(given | {"admin_key": key} | settings))
    with log.open("wb") as output:
        process = subprocess.Popen(
            [sys.executable, "-m", "app.cli", "serve"],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            env=environment,
        )
    server = None
    try:
        url = _await_ready(process, log, start_s)
        server = OwnServer(url, key, process, log)
        yield server
    finally:
        if process.poll() is None:
            (server or OwnServer("", key, process, log)).stop()


def _await_ready(process: "subprocess.Popen[bytes]", log: Path, start_s: float) -> str:
    """Wait for the line that says where it listens."""
    deadline = time.monotonic() + start_s
    while time.monotonic() < deadline:
        ready = _READY.search(log.read_text(errors="replace"))
        if ready:
            return ready[1]
        if process.poll() is not None:
            raise OwnServerError(f"The service did not start: {_read_tail(log)}")
        time.sleep(0.05)
    raise OwnServerError(f"The service was not ready within {start_s:g} s: {_read_tail(log)}")


def _read_tail(log: Path) -> str:
    return log.read_text(errors="replace")[-_TAIL_CHARACTERS:].strip() or "(no log)"
