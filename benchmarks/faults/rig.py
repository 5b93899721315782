"""The service under test: started, stopped and killed as an operator or the kernel does it."""

import json
import os
import secrets
import signal
import subprocess
from collections import Counter
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

from app.commands.own_server import OwnServer, run_own_server
from app.settings import Settings, load_settings
from benchmarks.faults.cluster import find_free_port

QUICK = {
    "finetune_steps": 4,
    "finetune_nice": 0,
    "lease_s": 3.0,
    "heartbeat_s": 0.5,
    "worker_poll_s": 0.2,
    "watch_s": 0.3,
    "database_timeout_s": 2.0,
    "log_format": "json",
}
"""Small fits and short leases, so that a repeat takes seconds."""
START_S = 240.0
"""A machine that is busy with other things starts slowly."""
_RESTARTS_BEFORE_THE_PAUSE_GROWS = 2


class Rig:
    """One service with its worker, on one address for as long as the rig lives.

    Attributes:
        url, key: where it listens, and its admin key.
        model: the file of the base model, which has to be made before the start.
        is_up: whether it ought to answer now.
        settings: of its database, to look into it from outside.
    """

    def __init__(self, folder: Path, *, data_dir: Path, database_url: str | None) -> None:
        self._folder = folder
        self.model = folder / "base.safetensors"
        own = {"data_dir": data_dir, "model": self.model, "port": find_free_port()}
        self._given: dict[str, Any] = {**QUICK, **own}
        if database_url is not None:
            self._given["database_url"] = database_url
        self.url = f"http://127.0.0.1:{self._given['port']}"
        self.key = secrets.token_hex(24)
        self.is_up = False
        self.settings: Settings = load_settings({}, data_dir=data_dir, database_url=database_url)
        self._stack = ExitStack()
        self._server: OwnServer | None = None
        self._worker_kills = 0

    def start(self) -> None:
        """Start the service and wait until it is ready; it may run already."""
        if self.is_up:
            return
        (self._folder / "logs").mkdir(exist_ok=True)
        server = run_own_server(self._folder / "logs", key=self.key, start_s=START_S, **self._given)
        self._server = self._stack.enter_context(server)
        self._worker_kills = 0
        self.is_up = True

    def stop(self) -> None:
        """Stop it as an operator does."""
        self.is_up = False
        self._stack.close()

    def kill(self) -> None:
        """SIGKILL for the process that serves."""
        self.is_up = False
        if self._server is not None:
            self._server.process.kill()
            self._server.process.wait()
        self._stack.close()

    def kill_worker(self) -> bool:
        """SIGKILL for the worker, whose training process ends with it; tells if there was one."""
        pid = self._find_worker()
        if pid is not None:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
                self._worker_kills += 1
                return True
        return False

    def freshen(self) -> None:
        """Start again where the worker has died so often that its next start would be put off."""
        if self._worker_kills > _RESTARTS_BEFORE_THE_PAUSE_GROWS:
            self.stop()
        self.start()

    def count_warnings(self) -> Counter[str]:
        """Count what service and workers warned of so far, by what it was."""
        found: Counter[str] = Counter()
        for line in self.read_logs().splitlines():
            with suppress(ValueError):
                told = json.loads(line)
                if told["level"] in {"warning", "error", "critical"}:
                    found[told["event"]] += 1
        return found

    def read_logs(self) -> str:
        """Give everything that was written to the log."""
        folder = self._folder / "logs"
        return "".join(path.read_text(errors="replace") for path in sorted(folder.glob("*.log")))

    def _find_worker(self) -> int | None:
        if self._server is None:
            return None
        listed = subprocess.run(
            ["ps", "-o", "pid=,args=", "--ppid", str(self._server.process.pid)],
            capture_output=True,
            text=True,
            check=False,
        ).stdout
        found = [int(line.split()[0]) for line in listed.splitlines() if " worker --tied" in line]
        return found[0] if found else None
