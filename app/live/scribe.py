"""Carries out the steps of a stream's recording, beside everything else that the stream does."""

import asyncio
from collections.abc import Callable

from app.domain.errors import KinecastError
from app.live.steps import Archive, Outcome, Step


class Scribe:
    """A queue of one step: its session asks for the next one when it knows what came of this.

    Args:
        archive: carries steps out.
        note: told what came of each.
    """

    def __init__(self, archive: Archive, note: Callable[[Outcome | KinecastError], None]) -> None:
        self._archive, self._note = archive, note
        self._steps: asyncio.Queue[Step] = asyncio.Queue(maxsize=1)

    def put(self, step: Step) -> None:
        """Have a step carried out; there must be no other one."""
        self._steps.put_nowait(step)

    async def run(self) -> None:
        """Carry steps out for ever."""
        while True:
            step = await self._steps.get()
            outcome: Outcome | KinecastError
            try:
                outcome = await self._archive(step)
            except KinecastError as error:
                outcome = error
            self._note(outcome)  # which may put the next step
            self._steps.task_done()

    async def settle(self, timeout_s: float, running: asyncio.Task[None]) -> None:
        """Wait until nothing is to be done, but not for long, nor for a `run` that has ended."""
        done = asyncio.create_task(self._steps.join())
        await asyncio.wait({done, running}, timeout=timeout_s, return_when=asyncio.FIRST_COMPLETED)
        done.cancel()
