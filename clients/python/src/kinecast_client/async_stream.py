"""A stream for programs with an event loop."""

import asyncio
import logging
import time
from collections import deque
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import suppress
from types import TracebackType
from typing import Any

from kinecast_client.core import Phase
from kinecast_client.errors import DeadlineError, KinecastError, StoppedError
from kinecast_client.events import Event
from kinecast_client.forecasts import Forecast
from kinecast_client.link import Target
from kinecast_client.recordings import RecordingStatus
from kinecast_client.stream import OPEN_S, STOP_S
from kinecast_client.stream_base import DECIDED, OVER, RecordingBase, StreamBase, StreamOptions

_EVENTS_KEPT = 1024

log = logging.getLogger("kinecast_client")
OnForecastAsync = Callable[[Forecast], Awaitable[None] | None]
OnEventAsync = Callable[[Event], Awaitable[None] | None]


class AsyncStream(StreamBase):
    """Forecasts of one user while frames are sent. Made by `AsyncClient.stream`; use `async with`.

    The connection lives on the event loop that made it, and comes back by itself. `send`, `latest`
    and whatever else is not awaited never wait.
    """

    def __init__(
        self,
        target: Target,
        options: StreamOptions,
        *,
        on_forecast: OnForecastAsync | None,
        on_event: OnEventAsync | None,
    ) -> None:
        super().__init__(target, options)
        self._changed = asyncio.Event()
        self._seen = 0
        self._events: deque[Event] | None = None if on_event is None else deque(maxlen=_EVENTS_KEPT)
        self._running = asyncio.ensure_future(self._link.run())
        self._calling: asyncio.Future[None] | None = None
        if on_forecast is not None or on_event is not None:
            self._calling = asyncio.ensure_future(self._call_back(on_forecast, on_event))

    async def __aenter__(self) -> "AsyncStream":
        """Wait until it is open; see `open`."""
        try:
            return await self.open()
        except BaseException:
            await self.close()
            raise

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close it."""
        await self.close()

    async def open(self, timeout_s: float = OPEN_S) -> "AsyncStream":
        """Wait until the service has said hello.

        Raises:
            StoppedError: the service refuses the stream.
            UnreachableError: it could not be opened in time. It goes on trying until `close`.
        """
        await self._await(lambda: self._core.phase in DECIDED, timeout_s)
        self.check()
        if self._core.phase is not Phase.OPEN:
            raise self._explain_absence()
        return self

    async def close(self) -> None:
        """Close it. Calling this again does nothing."""
        self._link.end()
        with self._lock:
            self._core.close()
        self._tell([])
        await asyncio.wait({self._running})
        if self._calling is not None and self._calling is not asyncio.current_task():
            self._calling.cancel()
            await asyncio.wait({self._calling})

    async def wait(self, timeout_s: float) -> Forecast | None:
        """Wait for a forecast that this method has not given yet.

        Returns:
            The newest one that may be used; None where none came in time, or the stream is closed.

        Raises:
            StoppedError: the stream ended for good.
        """
        forecast, self._seen = await self._await_news(self._seen, timeout_s)
        return forecast

    async def forecasts(self, timeout_s: float | None = None) -> AsyncIterator[Forecast | None]:
        """Give one forecast after the other, the newest wins; ends when the stream is closed.

        Args:
            timeout_s: give None each time that no forecast came for this long; None gives
                forecasts only, and waits for them as long as the stream lives.

        Raises:
            StoppedError: the stream ended for good.
        """
        seen = 0
        while self._core.phase is not Phase.CLOSED:
            forecast, seen = await self._await_news(seen, timeout_s)
            if forecast is not None or (timeout_s is not None and not self._is_closed):
                yield forecast

    async def __aiter__(self) -> AsyncIterator[Forecast]:
        """Give one forecast after the other, the newest wins; see `forecasts`."""
        async for forecast in self.forecasts():
            if forecast is not None:
                yield forecast

    def record(self, label: str | None = None, *, trial: str | None = None) -> "AsyncRecording":
        """Record what is sent from now on; needs a key with the scope `record`. Never waits.

        Args:
            label: a name for people.
            trial: a UUID of your own, or that of a recording to go on with; drawn if absent.

        Raises:
            RecordingError: another recording of this stream is not over yet.
            ValueError: the label or the id cannot be one.
        """
        return AsyncRecording(self, self._start_recording(trial, label))

    @property
    def _is_closed(self) -> bool:
        return self._core.phase is Phase.CLOSED

    async def _await_news(self, seen: int, timeout_s: float | None) -> tuple[Forecast | None, int]:
        """Wait for a usable forecast after the `seen`-th."""
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        while True:
            core = self._core
            forecast = core.latest(self._now()) if core.generation > seen else None
            seen = core.generation
            if forecast is not None or core.phase is Phase.CLOSED:
                return forecast, seen
            self.check()
            left = None if deadline is None else deadline - time.monotonic()
            if left is not None and left <= 0:
                return None, seen
            await self._await(lambda: core.generation > seen or core.phase in OVER, left)  # noqa: B023 - awaited at once

    async def _await(self, is_so: Callable[[], bool], timeout_s: float | None) -> bool:
        """Wait until something is so; tells whether it is."""
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        while not is_so():
            left = None if deadline is None else deadline - time.monotonic()
            if left is not None and left <= 0:
                return False
            changed = self._changed
            with suppress(asyncio.TimeoutError):
                await asyncio.wait_for(changed.wait(), left)
        return True

    def _tell(self, events: list[Event]) -> None:
        if self._events is not None:
            self._events.extend(events)
        changed, self._changed = self._changed, asyncio.Event()
        changed.set()

    async def _call_back(
        self, on_forecast: OnForecastAsync | None, on_event: OnEventAsync | None
    ) -> None:
        """Call the callbacks until the stream is over."""
        seen, core = 0, self._core
        while True:
            await self._await(
                lambda: bool(self._events) or core.generation > seen or core.phase in OVER,  # noqa: B023 - awaited at once
                None,
            )
            events = list(self._events or ())
            if self._events:
                self._events.clear()
            for event in events:
                await self._call(on_event, event)
            if core.generation > seen:
                seen = core.generation
                forecast = core.latest(self._now())
                if forecast is not None:
                    await self._call(on_forecast, forecast)
            elif core.phase in OVER and not events:
                return

    async def _call(
        self, callback: Callable[[Any], Awaitable[None] | None] | None, value: object
    ) -> None:
        if callback is None:
            return
        try:
            result = callback(value)
            if result is not None:
                await result
        except Exception:
            self._core.tally.callback_errors += 1
            log.exception("a callback failed")


class AsyncRecording(RecordingBase):
    """A recording on a stream. Made by `AsyncStream.record`.

    In `async with`, the end of the block stops it; an exception stops it without fine-tuning.
    """

    _stream: AsyncStream

    async def __aenter__(self) -> "AsyncRecording":
        """Begin the block that is recorded."""
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Stop it, unless that was done already."""
        if kind is None and not self.status.is_over:
            await self.stop()
        elif kind is None:
            self._judge()
        elif not self.status.is_over:
            with suppress(KinecastError):  # the block's own exception says more
                await self.stop(finetune=False)

    async def stop(self, *, finetune: bool = True, timeout_s: float = STOP_S) -> RecordingStatus:
        """End it and wait until it is stored; `job` is the fine-tuning that was asked for.

        Raises:
            RecordingError: the service does not record it.
            DeadlineError: it was not stored in time; it will be once the service can be reached.
            StoppedError: the stream ended for good.
        """
        self._do(lambda outgoing: outgoing.end_recording("trial.stop", finetune=finetune))
        return await self._await_end(timeout_s)

    async def cancel(self, *, timeout_s: float = STOP_S) -> RecordingStatus:
        """Throw it away; raises as `stop` does."""
        self._do(lambda outgoing: outgoing.end_recording("trial.cancel"))
        return await self._await_end(timeout_s)

    async def _await_end(self, timeout_s: float) -> RecordingStatus:
        stream = self._stream
        is_over = await stream._await(  # noqa: SLF001 - the two are one
            lambda: self.status.is_over or stream._core.phase in OVER,  # noqa: SLF001
            timeout_s,
        )
        if not self.status.is_over:
            stream.check()
            if is_over:
                raise StoppedError(1000, "closed", "The stream was closed before it was stored.")
            raise DeadlineError(f"The recording was not stored within {timeout_s:g} s.")
        return self._judge()
