"""The ledger: every reading of the test subjects leaves a line, so that nobody reads in secret.

One JSON object per line: when, at which commit, what was read, with which settings, and the
figures that were seen.
"""

import fcntl
import json
import os
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from models.training.pretrain import current_commit


def record_reading(
    path: Path,
    *,
    what: str,
    config: Mapping[str, Any],
    figures: Mapping[str, Any] | Sequence[Any],
) -> None:
    """Append one line to a ledger, which is begun if it is not there.

    Whole lines only: processes take turns, a line that could not be written whole is taken back,
    and it is on the disk when this returns.

    Args:
        path: the ledger.
        what: was read, with which command.
        config: what decides the figures: data, model, settings.
        figures: what was seen.

    Raises:
        OSError: the file cannot be written.
        ValueError: a figure is not finite.
    """
    line = {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "commit": current_commit(),
        "what": what,
        "config": config,
        "figures": figures,
    }
    text = json.dumps(line, ensure_ascii=False, allow_nan=False) + "\n"
    with path.open("ab+", buffering=0) as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        _append_whole(file.fileno(), text.encode())


def _append_whole(handle: int, line: bytes) -> None:
    """Write a line behind the last whole one, or nothing."""
    end = os.fstat(handle).st_size
    if end and os.pread(handle, 1, end - 1) != b"\n":
        line = b"\n" + line
    try:
        rest = memoryview(line)
        while rest:
            rest = rest[os.write(handle, rest) :]
        os.fsync(handle)
    except OSError:
        os.ftruncate(handle, end)
        raise
