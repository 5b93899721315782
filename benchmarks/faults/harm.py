"""What is broken, and how it is mended again."""

import os
import subprocess
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from random import Random

from benchmarks.faults.cluster import Cluster
from benchmarks.faults.rig import Rig

DISK_BYTES = 160 * 2**20
_BLOCK = 2**20


@dataclass(frozen=True, slots=True)
class Harm:
    """One kind of fault.

    Attributes:
        name: as the table has it.
        strike: breaks something at once.
        hold_s: shortest and longest time until it is mended.
        mend: brings back what does not come back by itself, and waits until it is there.
    """

    name: str
    strike: Callable[[], None]
    mend: Callable[[], None]
    hold_s: tuple[float, float] = (0.0, 0.5)


def kill_worker(rig: Rig) -> Harm:
    """SIGKILL for the worker, which the service starts again."""

    def strike() -> None:
        rig.kill_worker()

    return Harm("worker", strike, _nothing)


def kill_service(rig: Rig) -> Harm:
    """SIGKILL for the service; somebody starts it again."""
    return Harm("api", rig.kill, rig.start)


def kill_both(rig: Rig) -> Harm:
    """SIGKILL for the worker and the service, as when a machine goes down."""

    def strike() -> None:
        rig.kill_worker()
        rig.kill()

    return Harm("both", strike, rig.start)


def stop_database(cluster: Cluster, random: Random) -> Harm:
    """Stop PostgreSQL, half of the time by a crash, and start it again."""

    def strike() -> None:
        cluster.stop(random.choice(("fast", "immediate")))

    return Harm("database", strike, cluster.start, hold_s=(0.5, 4.0))


def fill_disk(disk: "SmallDisk") -> Harm:
    """Leave not one byte on the disk of the database, and tidy up again."""
    return Harm("disk", disk.fill, disk.free, hold_s=(0.5, 4.0))


def do_nothing() -> Harm:
    """Break nothing: what the others are compared with."""
    return Harm("none", _nothing, _nothing)


def _nothing() -> None:
    return


class NoDiskError(RuntimeError):
    """No small disk can be mounted here."""


class SmallDisk:
    """A file system of its own in memory, small enough to be filled.

    Attributes:
        folder: where it is mounted.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir()
        options = f"size={DISK_BYTES},mode=700"
        done = subprocess.run(
            ["mount", "-t", "tmpfs", "-o", options, "kinecast-faults", folder],
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            raise NoDiskError(f"A small disk cannot be mounted: {done.stderr.strip()}")

    def fill(self) -> None:
        """Write until nothing more can be written."""
        with (self.folder / "ballast").open("wb", buffering=0) as file, suppress(OSError):
            while True:
                written = file.write(bytes(_BLOCK))
                if written < _BLOCK:
                    file.write(bytes(_BLOCK))
        with (self.folder / "ballast").open("ab", buffering=0) as file, suppress(OSError):
            while True:
                file.write(bytes(1))

    def free(self) -> None:
        """Remove what fills it."""
        (self.folder / "ballast").unlink(missing_ok=True)

    def is_full(self) -> bool:
        """Tell whether nothing is left."""
        found = os.statvfs(self.folder)
        return found.f_bavail == 0

    def remove(self) -> None:
        """Unmount it."""
        subprocess.run(["umount", "--lazy", self.folder], check=False)
