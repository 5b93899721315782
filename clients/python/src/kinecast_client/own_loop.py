"""An event loop on a thread of its own, for programs that have none."""

import asyncio
import os
import threading
from collections.abc import Coroutine
from concurrent.futures import CancelledError
from contextlib import suppress
from typing import Any, TypeVar

from kinecast_client.errors import DeadlineError
from kinecast_client.rest import Response, Rest, explain_delay

Answer = TypeVar("Answer")
_GRACE_S = 1.0
"""What works on the loop keeps deadlines itself; after this, the loop has ended, as in a fork."""


class OwnLoop:
    """An event loop on a thread of its own, with what asks a service there."""

    def __init__(self, url: str, key: str) -> None:
        self.loop = asyncio.new_event_loop()
        self.rest = Rest(url, key)
        self._url, self._pid = url, os.getpid()
        self._thread = threading.Thread(target=self._run, name="kinecast-client", daemon=True)
        self._thread.start()

    @property
    def is_alive(self) -> bool:
        """Whether it runs in this process: a fork has the object, but not the thread."""
        return self._pid == os.getpid()

    def ask(self, asking: Coroutine[Any, Any, Response], timeout_s: float) -> Response:
        """Wait for an answer; raises as `Rest.request` does, and where the loop is stopped."""
        future = asyncio.run_coroutine_threadsafe(asking, self.loop)
        try:
            return future.result(timeout_s + _GRACE_S)
        except DeadlineError:
            raise
        except TimeoutError:
            raise explain_delay(self._url, timeout_s) from None
        except CancelledError:
            raise RuntimeError("the client was closed") from None
        finally:
            future.cancel()

    def abandon(self) -> None:
        """Have it end, as far as it does at once: nobody is left who could close it."""
        if self.is_alive:
            with suppress(RuntimeError):  # it was closed
                self.loop.call_soon_threadsafe(self.loop.stop)
        if self._thread is not threading.current_thread():
            self._thread.join(_GRACE_S if self.is_alive else 0)

    def stop(self) -> None:
        """Stop it and wait for its end."""
        if not self.is_alive:
            return
        self.loop.call_soon_threadsafe(self.loop.stop)
        self._thread.join()

    def _run(self) -> None:
        asyncio.set_event_loop(self.loop)
        try:
            self.loop.run_forever()
        finally:
            tasks = asyncio.all_tasks(self.loop)
            for task in tasks:
                task.cancel()
            self.loop.run_until_complete(asyncio.gather(*tasks, return_exceptions=True))
            with suppress(Exception):  # a link that does not even close
                self.loop.run_until_complete(asyncio.wait_for(self.rest.close(), _GRACE_S))
            self.loop.run_until_complete(self.loop.shutdown_asyncgens())
            self.loop.close()
