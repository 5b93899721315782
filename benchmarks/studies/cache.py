"""Rows of studies as JSON lines: written as soon as they are known, never computed twice."""

import fcntl
import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parents[1] / "results"
Row = dict[str, Any]


def make_key(decided_by: Mapping[str, Any]) -> str:
    """Name what a row says by everything that decides it."""
    text = json.dumps(decided_by, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


class Cache:
    """The rows of one study; of two of the same unit the later one counts.

    Args:
        path: the file, which need not be there.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def read(self) -> dict[str, Row]:
        """Give the rows by unit. A line that a kill cut short is left out."""
        rows: dict[str, Row] = {}
        if not self.path.exists():
            return rows
        for line in self.path.read_text().splitlines():
            try:
                row = json.loads(line)
            except json.JSONDecodeError:
                continue
            rows[row["unit"]] = row
        return rows

    def add(self, row: Row) -> None:
        """Append a row, on a line of its own even after one that was cut short."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        line = json.dumps(row, separators=(",", ":"))
        with locked(self.path.parent), self.path.open("a+b") as file:
            file.seek(0, 2)
            torn = file.tell() > 0 and not _ends_line(file.tell(), self.path)
            file.write((("\n" if torn else "") + line + "\n").encode())

    def tidy(self) -> None:
        """Drop the rows of units that have a later one."""
        if self.path.exists():
            with locked(self.path.parent):
                self._rewrite()

    def _rewrite(self) -> None:
        lines = [json.dumps(row, separators=(",", ":")) for row in self.read().values()]
        draft = self.path.with_suffix(".part")
        draft.write_text("".join(f"{line}\n" for line in lines))
        draft.replace(self.path)


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Let other processes wait until the block ends; a folder, or a file that is made for it."""
    handle = os.open(path, os.O_RDONLY if path.is_dir() else os.O_CREAT | os.O_RDWR, 0o644)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def _ends_line(size: int, path: Path) -> bool:
    with path.open("rb") as file:
        file.seek(size - 1)
        return file.read(1) == b"\n"
