"""A stream for programs without an event loop."""

import asyncio
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import suppress
from types import TracebackType
from typing import Any

from kinecast_client.core import Phase
from kinecast_client.errors import DeadlineError, KinecastError, StoppedError
from kinecast_client.events import Event
from kinecast_client.forecasts import Forecast
from kinecast_client.link import CLOSE_S, Target
from kinecast_client.recordings import RecordingStatus
from kinecast_client.stream_base import DECIDED, OVER, RecordingBase, StreamBase, StreamOptions

OPEN_S = 5.0
STOP_S = 10.0
_EVENTS_KEPT = 1024

log = logging.getLogger("kinecast_client")
OnForecast = Callable[[Forecast], None]
OnEvent = Callable[[Event], None]


class Stream(StreamBase):
    """Forecasts of one user while frames are sent. Made by `Client.stream`; use it in `with`.

    The connection lives on a thread of the client. It comes back by itself, and every method may be
    called from any thread.
    """

    def __init__(
        self,
        target: Target,
        options: StreamOptions,
        *,
        loop: asyncio.AbstractEventLoop,
        owner: object,
        on_forecast: OnForecast | None,
        on_event: OnEvent | None,
    ) -> None:
        super().__init__(target, options)
        self._owner = owner  # the loop ends with it
        self._changed = threading.Condition(self._lock)
        self._seen = 0
        self._events: deque[Event] | None = None if on_event is None else deque(maxlen=_EVENTS_KEPT)
        self._running: Future[None] = asyncio.run_coroutine_threadsafe(self._link.run(), loop)
        if on_forecast is not None or on_event is not None:
            name = f"kinecast-callbacks-{target.user}"
            arguments = (on_forecast, on_event)
            threading.Thread(target=self._call_back, args=arguments, name=name, daemon=True).start()

    def __enter__(self) -> "Stream":
        """Wait until it is open; see `open`."""
        try:
            return self.open()
        except BaseException:
            self.close()
            raise

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close it."""
        self.close()

    def open(self, timeout_s: float = OPEN_S) -> "Stream":
        """Wait until the service has said hello.

        Raises:
            StoppedError: the service refuses the stream.
            UnreachableError: it could not be opened in time. It goes on trying until `close`.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._core.phase in DECIDED, timeout_s)
            phase = self._core.phase
        self.check()
        if phase is not Phase.OPEN:
            raise self._explain_absence()
        return self

    def close(self) -> None:
        """Close it. Calling this again does nothing."""
        with self._changed:
            self._core.close()
            self._changed.notify_all()
        self._link.end()  # after that, or a link that begins just now would miss both
        try:
            self._running.result(2 * CLOSE_S)
        except Exception:
            log.warning("a stream did not end by itself", exc_info=True)

    def wait(self, timeout_s: float) -> Forecast | None:
        """Wait for a forecast that this method has not given yet.

        Returns:
            The newest one that may be used; None where none came in time, or the stream is closed.

        Raises:
            StoppedError: the stream ended for good.
        """
        forecast, self._seen = self._await_news(self._seen, timeout_s)
        return forecast

    def forecasts(self, timeout_s: float | None = None) -> Iterator[Forecast | None]:
        """Give one forecast after the other, the newest wins; ends when the stream is closed.

        Args:
            timeout_s: give None each time that no forecast came for this long; None gives
                forecasts only, and waits for them as long as the stream lives.

        Raises:
            StoppedError: the stream ended for good.
        """
        seen = 0
        while self._core.phase is not Phase.CLOSED:
            forecast, seen = self._await_news(seen, timeout_s)
            if forecast is not None or (timeout_s is not None and not self._is_closed):
                yield forecast

    def __iter__(self) -> Iterator[Forecast]:
        """Give one forecast after the other, the newest wins; see `forecasts`."""
        return (forecast for forecast in self.forecasts() if forecast is not None)

    def record(self, label: str | None = None, *, trial: str | None = None) -> "Recording":
        """Record what is sent from now on; needs a key with the scope `record`. Never waits.

        Args:
            label: a name for people.
            trial: a UUID of your own, or that of a recording to go on with; drawn if absent.

        Raises:
            RecordingError: another recording of this stream is not over yet.
            ValueError: the label or the id cannot be one.
        """
        return Recording(self, self._start_recording(trial, label))

    @property
    def _is_closed(self) -> bool:
        return self._core.phase is Phase.CLOSED

    def _await_news(self, seen: int, timeout_s: float | None) -> tuple[Forecast | None, int]:
        """Wait for a usable forecast after the `seen`-th."""
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        with self._changed:
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
                self._changed.wait(left)

    def _tell(self, events: list[Event]) -> None:
        with self._changed:
            if self._events is not None:
                self._events.extend(events)
            self._changed.notify_all()

    def _call_back(self, on_forecast: OnForecast | None, on_event: OnEvent | None) -> None:
        """Call the callbacks until the stream is over, on a thread of its own."""
        seen = 0
        while True:
            with self._changed:
                core = self._core
                while not self._events and core.generation == seen and core.phase not in OVER:
                    self._changed.wait()
                events = list(self._events or ())
                if self._events:
                    self._events.clear()
                forecast = core.latest(self._now()) if core.generation > seen else None
                is_over = core.phase in OVER and not events
                seen = core.generation
            if is_over:
                return
            for event in events:
                self._call(on_event, event)
            if forecast is not None:
                self._call(on_forecast, forecast)

    def _call(self, callback: Callable[[Any], None] | None, value: object) -> None:
        if callback is None:
            return
        try:
            callback(value)
        except (Exception, SystemExit):  # a callback cannot end the program, only its own calls
            self._core.tally.callback_errors += 1
            log.exception("a callback failed")


class Recording(RecordingBase):
    """A recording on a stream. Made by `Stream.record`.

    In `with`, the end of the block stops it; an exception stops it without fine-tuning.
    """

    _stream: Stream

    def __enter__(self) -> "Recording":
        """Begin the block that is recorded."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Stop it, unless that was done already."""
        if kind is None and not self.status.is_over:
            self.stop()
        elif kind is None:
            self._judge()
        elif not self.status.is_over:
            with suppress(KinecastError):  # the block's own exception says more
                self.stop(finetune=False)

    def stop(self, *, finetune: bool = True, timeout_s: float = STOP_S) -> RecordingStatus:
        """End it and wait until it is stored; `job` is the fine-tuning that was asked for.

        Raises:
            RecordingError: the service does not record it.
            DeadlineError: it was not stored in time; it will be once the service can be reached.
            StoppedError: the stream ended for good.
        """
        self._do(lambda outgoing: outgoing.end_recording("trial.stop", finetune=finetune))
        return self._await_end(timeout_s)

    def cancel(self, *, timeout_s: float = STOP_S) -> RecordingStatus:
        """Throw it away; raises as `stop` does."""
        self._do(lambda outgoing: outgoing.end_recording("trial.cancel"))
        return self._await_end(timeout_s)

    def _await_end(self, timeout_s: float) -> RecordingStatus:
        stream = self._stream
        with stream._changed:  # noqa: SLF001 - the two are one
            is_over = stream._changed.wait_for(  # noqa: SLF001
                lambda: self.status.is_over or stream._core.phase in OVER,  # noqa: SLF001
                timeout_s,
            )
        if not self.status.is_over:
            stream.check()
            if is_over:
                raise StoppedError(1000, "closed", "The stream was closed before it was stored.")
            raise DeadlineError(f"The recording was not stored within {timeout_s:g} s.")
        return self._judge()
