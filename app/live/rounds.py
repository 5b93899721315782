"""Something that is done again and again in the background, between `start` and `stop`."""

import asyncio
import time
from collections.abc import Awaitable, Callable

import structlog

Pause = Callable[[float], Awaitable[None]]
"""Waits this many seconds, or less where there may be news."""

TELL_EVERY_S = 60.0
"""A mistake that repeats is logged this often at most."""

log = structlog.get_logger(__name__)


class Mistakes:
    """Logs what nobody foresaw, without a flood where it happens again and again.

    Args:
        what: where it happens.
        clock: monotonic, seconds.
    """

    def __init__(self, what: str, clock: Callable[[], float] = time.monotonic) -> None:
        self._what, self._clock = what, clock
        self._told: dict[str, float] = {}
        self._untold = 0

    def tell(self, error: Exception) -> None:
        """Log a mistake with its traceback, unless its kind was logged a moment ago."""
        kind, now = type(error).__name__, self._clock()
        if now - self._told.get(kind, -TELL_EVERY_S) < TELL_EVERY_S:
            self._untold += 1
            return
        log.error("a mistake", where=self._what, untold=self._untold, exc_info=error)
        self._told[kind], self._untold = now, 0


class Rounds:
    """Repeats a step, with a pause before each.

    A step that raises is logged, and the next round comes all the same: what is done in the
    background must neither end unseen nor take the end of the process with it.

    Args:
        step: what is done; raises nothing that it can deal with itself.
        every_s: how long to pause.
        listen: gives a way to pause, once for all rounds.
    """

    def __init__(
        self,
        step: Callable[[], Awaitable[object]],
        *,
        every_s: float,
        listen: Callable[[], Pause] = lambda: asyncio.sleep,
    ) -> None:
        self._step, self._pause_s, self._pause_by = step, every_s, listen
        self._mistakes = Mistakes(getattr(step, "__qualname__", type(self).__name__))
        self._running: asyncio.Task[None] | None = None
        self._is_stopping = False

    def start(self) -> None:
        """Begin."""
        self._is_stopping = False
        self._running = asyncio.create_task(self._go())

    async def stop(self) -> None:
        """End, in the middle of a step if need be; raises nothing of what the steps raised."""
        running, self._running = self._running, None
        if running is None:
            return
        self._is_stopping = True  # a step may make something else of its cancellation
        running.cancel()
        await asyncio.wait({running})
        if not running.cancelled():
            running.exception()  # was logged; asking for it is what asyncio wants

    async def _go(self) -> None:
        pause = self._pause_by()
        while not self._is_stopping:
            try:
                await pause(self._pause_s)
            except Exception as error:  # noqa: BLE001 - see the class
                self._mistakes.tell(error)
                await asyncio.sleep(self._pause_s)
            try:
                await self._step()
            except Exception as error:  # noqa: BLE001 - see the class
                self._mistakes.tell(error)
