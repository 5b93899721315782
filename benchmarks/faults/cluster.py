"""A PostgreSQL of one's own, which may be stopped; the machine's is never touched."""

import os
import shutil
import socket
import subprocess
import tempfile
from pathlib import Path
from typing import Literal

StopMode = Literal["fast", "immediate"]
_ACCOUNT = "postgres"
_USUAL = Path("/usr/lib/postgresql")


class NoClusterError(RuntimeError):
    """There is no PostgreSQL to start here; the message says what is missing."""


class Cluster:
    """A cluster in a temporary folder.

    Attributes:
        url: of its database.
    """

    def __init__(self) -> None:
        self._programs = _find_programs()
        self._account = _ACCOUNT if os.geteuid() == 0 else None
        self._folder = Path(tempfile.mkdtemp(prefix="kinecast-faults-pg-"))
        self._port = find_free_port()
        self.url = f"postgresql://{_ACCOUNT}@127.0.0.1:{self._port}/postgres"
        if self._account is not None:
            shutil.chown(self._folder, self._account)
        self._run("initdb", "-U", _ACCOUNT, "-A", "trust", "-E", "UTF8", "-D", self._data)

    @property
    def _data(self) -> str:
        return str(self._folder / "data")

    def start(self) -> None:
        """Start it and wait until it answers."""
        options = f"-p {self._port} -c listen_addresses=127.0.0.1 -c unix_socket_directories=''"
        log = str(self._folder / "log")
        self._run("pg_ctl", "-D", self._data, "-w", "-o", options, "-l", log, "start")

    def stop(self, mode: StopMode = "fast") -> None:
        """Stop it: `fast` ends sessions properly, `immediate` is a crash."""
        self._run("pg_ctl", "-D", self._data, "-w", "-m", mode, "stop")

    def remove(self) -> None:
        """Stop it where it runs, and remove all of it."""
        if (self._folder / "data" / "postmaster.pid").exists():
            self.stop("immediate")
        shutil.rmtree(self._folder, ignore_errors=True)

    def _run(self, program: str, *arguments: str) -> None:
        done = subprocess.run(
            [self._programs / program, *arguments],
            user=self._account,
            cwd=self._folder,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,  # a pipe would stay open in the server that is started
            stderr=subprocess.DEVNULL,
            check=False,
            timeout=120,
        )
        if done.returncode:
            raise NoClusterError(f"{program} ended with status {done.returncode}.")


def find_free_port() -> int:
    """Give a port of this machine that nobody uses now."""
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        port: int = found.getsockname()[1]
        return port


def _find_programs() -> Path:
    """Find the folder of PostgreSQL's own programs, the newest where there are several."""
    on_path = shutil.which("initdb")
    if on_path is not None:
        return Path(on_path).parent
    found = [path.parent for path in _USUAL.glob("*/bin/initdb")]
    if not found:
        raise NoClusterError("PostgreSQL's initdb is not installed.")
    return max(found, key=lambda folder: int(folder.parent.name))
