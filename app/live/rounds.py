"""Something that is done again and again in the background, between `start` and `stop`."""

import asyncio
from collections.abc import Awaitable, Callable
from contextlib import suppress

Pause = Callable[[float], Awaitable[None]]
"""Waits this many seconds, or less where there may be news."""


class Rounds:
    """Repeats a step, with a pause before each.

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
        self._running: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Begin."""
        self._running = asyncio.create_task(self._go())

    async def stop(self) -> None:
        """End, in the middle of a step if need be; raises what has ended the rounds before."""
        if self._running is not None:
            self._running.cancel()
            with suppress(asyncio.CancelledError):
                await self._running
        self._running = None

    async def _go(self) -> None:
        pause = self._pause_by()
        while True:
            await pause(self._pause_s)
            await self._step()
