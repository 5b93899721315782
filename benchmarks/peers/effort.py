"""How long processors worked on a server: that depends less than a rate on who else is busy."""

import os
from pathlib import Path

PROC = Path("/proc")
PARENT, WORKED = 1, slice(11, 15)
"""Places in a process's `stat` after its name: the parent; user and system, own and of children."""


def measure_effort(root: int, proc: Path = PROC) -> float | None:
    """Give the processor seconds of a process and all that it has started; None off Linux."""
    table: dict[int, tuple[int, int]] = {}
    for file in proc.glob("[0-9]*/stat"):
        try:
            told = file.read_text().rpartition(")")[2].split()
        except OSError:  # it has just ended
            continue
        table[int(file.parent.name)] = (int(told[PARENT]), sum(map(int, told[WORKED])))
    if root not in table:
        return None
    ours = {root}
    while grown := {pid for pid, (parent, _) in table.items() if parent in ours} - ours:
        ours |= grown
    return sum(table[pid][1] for pid in ours) / os.sysconf("SC_CLK_TCK")
