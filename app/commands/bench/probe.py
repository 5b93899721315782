"""What this machine does to a program that only wants to sleep: pauses that no service causes."""

import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64

STEP_S = 0.002
PAUSE_S = 0.005
"""Waking up later than this counts as a pause."""


class Pause(NamedTuple):
    """A time in which the load generator could not run, on the clock of `time.monotonic`."""

    begin: float
    end: float

    @property
    def seconds(self) -> float:
        """How long it was."""
        return self.end - self.begin


class IdleProbe:
    """A thread that sleeps 2 ms at a time and notes when it is woken too late.

    Latencies that overlap such a pause say more about a crowded machine than about the service.
    """

    def __init__(self) -> None:
        self.pauses: list[Pause] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="idle-probe", daemon=True)

    @contextmanager
    def running(self) -> Iterator["IdleProbe"]:
        """Probe until the block ends."""
        self._thread.start()
        try:
            yield self
        finally:
            self._stop.set()
            self._thread.join(1.0)

    def _watch(self) -> None:
        before = time.monotonic()
        while not self._stop.is_set():
            time.sleep(STEP_S)
            now = time.monotonic()
            if now - before - STEP_S > PAUSE_S:
                self.pauses.append(Pause(before + STEP_S, now))
            before = now


def find_overlaps(
    begins: Float64[np.ndarray, " interval"],
    ends: Float64[np.ndarray, " interval"],
    pauses: Sequence[Pause],
) -> Bool[np.ndarray, " interval"]:
    """Tell which intervals have a part in common with any pause."""
    if not pauses:
        return np.zeros(len(begins), dtype=bool)
    starts = np.array([pause.begin for pause in pauses])
    stops = np.array([pause.end for pause in pauses])
    ended_before = np.searchsorted(stops, begins, side="left")
    begun_before = np.searchsorted(starts, ends, side="right")
    return np.asarray(begun_before > ended_before)
