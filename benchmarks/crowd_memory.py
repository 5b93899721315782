"""How much memory a service, its worker and whatever trains take, sampled while they run."""

import asyncio
from contextlib import suppress
from pathlib import Path
from typing import Any

EVERY_S = 1.0
_PROC = Path("/proc")


class MemoryLog:
    """Resident memory of a process, of its worker, and of the largest child of that.

    Args:
        service: the process that serves; its child is the worker.
    """

    def __init__(self, service: int) -> None:
        self._service = service
        self._samples: dict[str, list[float]] = {"service": [], "worker": [], "training": []}

    async def sample_for_ever(self) -> None:
        """Take a sample every second."""
        while True:
            self._sample()
            await asyncio.sleep(EVERY_S)

    def summarise(self) -> dict[str, dict[str, Any]]:
        """Give each one's memory in MiB: at first, in the middle, at its highest, and at last."""
        return {
            name: {
                "start": round(values[0]),
                "median": round(sorted(values)[len(values) // 2]),
                "max": round(max(values)),
                "end": round(values[-1]),
            }
            for name, values in self._samples.items()
            if values
        }

    def _sample(self) -> None:
        workers = _list_children(self._service)
        training = [child for worker in workers for child in _list_children(worker)]
        for name, processes in (
            ("service", [self._service]),
            ("worker", workers),
            ("training", training),
        ):
            sizes = [size for one in processes if (size := _read_resident(one)) is not None]
            if sizes:
                self._samples[name].append(max(sizes))


def _list_children(process: int) -> list[int]:
    found: list[int] = []
    for tasks in (_PROC / str(process) / "task").glob("*/children"):
        with suppress(OSError):
            found += [int(child) for child in tasks.read_text().split()]
    return found


def _read_resident(process: int) -> float | None:
    with suppress(OSError):
        for line in (_PROC / str(process) / "status").read_text().splitlines():
            if line.startswith("VmRSS:"):
                return int(line.split()[1]) / 1024
    return None
