"""An event loop that wakes up when it was told to, not up to a millisecond later."""

import asyncio
import select
import selectors
from collections.abc import Coroutine
from typing import Any, TypeVar

Result = TypeVar("Result")


class PreciseSelector(selectors.DefaultSelector):
    """The best selector of this machine, with timeouts in microseconds.

    epoll rounds its timeouts up to whole milliseconds. An epoll object is itself a file that can
    be waited for, and `select` waits for it by the microsecond; as that is the only file that it
    ever sees, its limit of 1,024 files does not matter.
    """

    def select(self, timeout: float | int | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        """Wait until a file is ready, or the time is over; see `selectors`."""
        if timeout is not None and timeout > 0:
            if not select.select((self.fileno(),), (), (), timeout)[0]:
                return []
            timeout = 0
        return super().select(timeout)


def run_precisely(main: Coroutine[Any, Any, Result]) -> Result:
    """Run a coroutine as `asyncio.run` does, with precise timers where this machine has them."""
    with asyncio.Runner(loop_factory=_make_loop) as runner:
        return runner.run(main)


def _make_loop() -> asyncio.AbstractEventLoop:
    can_be_waited_for = hasattr(selectors.DefaultSelector, "fileno")  # epoll, kqueue, devpoll
    return asyncio.SelectorEventLoop(PreciseSelector() if can_be_waited_for else None)
