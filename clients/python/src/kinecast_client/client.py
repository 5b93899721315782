"""The client for programs without an event loop."""

import threading
import time
import weakref
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import TypeVar

import httpx

from kinecast_client import calls
from kinecast_client.address import read_url
from kinecast_client.answers import read_answer
from kinecast_client.calls import Call
from kinecast_client.checks import check_key, check_settings, check_stream
from kinecast_client.errors import UnreachableError
from kinecast_client.forecasts import Forecast
from kinecast_client.frames import Array
from kinecast_client.link import Target
from kinecast_client.messages import Form, Settings
from kinecast_client.own_loop import OwnLoop
from kinecast_client.resources import Jobs, Trials, Users, Versions
from kinecast_client.rest import Response
from kinecast_client.rules import Rules
from kinecast_client.stream import OnEvent, OnForecast, Stream
from kinecast_client.stream_base import StreamOptions

Answer = TypeVar("Answer")
TIMEOUT_S = 10.0


class Client:
    """A Kinecast service, for programs without an event loop. Use it in `with`, or `close` it.

    Every call has a deadline and raises, beside what it says itself, `ApiError` where the service
    answers with a problem, `UnreachableError` where nobody answers, `DeadlineError` where no answer
    comes in time, `AnswerError` where it makes no sense. It may be used from any thread. A process
    that is forked can go on asking; its streams belong to the one that opened them.

    Args:
        url: of the service, such as `http://127.0.0.1:8000`.
        key: the API key.
        timeout_s: longest wait for an answer, where a call says nothing else.

    Raises:
        ValueError: `url` is no address, or `key` cannot be one.
    """

    users: Users
    trials: Trials
    versions: Versions
    jobs: Jobs

    def __init__(self, url: str, key: str, *, timeout_s: float = TIMEOUT_S) -> None:
        self.url = read_url(url)
        self._key, self._timeout_s = check_key(key), timeout_s
        self._is_closed = False
        self._own: OwnLoop | None = None
        self._lock = threading.Lock()
        self._streams: weakref.WeakSet[Stream] = weakref.WeakSet()
        self.users, self.trials = Users(self._send), Trials(self._send)
        self.versions, self.jobs = Versions(self._send), Jobs(self._send)

    def __enter__(self) -> "Client":
        """Begin to use it; nothing is sent yet."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close it."""
        self.close()

    def close(self) -> None:
        """Close it and its streams."""
        self._is_closed = True
        for stream in list(self._streams):
            stream.close()
        with self._lock:
            own, self._own = self._own, None
        if own is not None:
            own.stop()

    def is_ready(self) -> bool:
        """Tell whether the service can forecast now."""
        try:
            status = self._request(Call("GET", "/readyz", bytes), self._timeout_s).status
        except UnreachableError:
            return False
        return status == httpx.codes.OK

    def forecast(
        self,
        user: str,
        frames: Array,
        t: Array | None = None,
        *,
        confidence: Array | None = None,
        version: str | int = "active",
        coverage: float = 0.9,
        timeout_s: float | None = None,
    ) -> Forecast:
        """Ask for one forecast; a stream is quicker where many are wanted.

        Args:
            user: whose motion.
            frames: [T, J, 3] metres, the newest last, spanning 0.45 s or more; NaN where missing.
            t: [T] seconds, strictly increasing; 30 Hz with the newest at 0 if absent.
            confidence: [T, J] from 0 to 1.
            version: `active`, `base` or a number.
            coverage: probability for `radius`.
            timeout_s: longest wait for the answer.

        Raises:
            FrameError: an array has another shape.
        """
        call = calls.forecast(
            user, frames, t, confidence=confidence, version=version, coverage=coverage
        )
        return self._send(call, timeout_s)

    def stream(
        self,
        user: str,
        *,
        on_forecast: OnForecast | None = None,
        on_event: OnEvent | None = None,
        forecast_every: int = 1,
        coverage: float = 0.9,
        version: str | int = "active",
        max_age_s: float = 0.2,
        hold_s: float = 0.15,
        session: str | None = None,
        joints: Sequence[str] | None = None,
        clock: Callable[[], float] = time.monotonic,
        form: Form = "msgpack",
    ) -> Stream:
        """Open a stream of a user: send frames, get forecasts. Use it in `with`.

        Args:
            user: whose motion.
            on_forecast: called with every forecast, on a thread of its own; the newest wins where
                it is slow. What it raises is logged and counted.
            on_event: called with everything else that happens, on the same thread.
            forecast_every: answer every n-th frame.
            coverage: probability for `radius`.
            version: `active`, `base` or a number.
            max_age_s: a forecast whose newest frame is older is never handed out.
            hold_s: a forecast counts for this long after it came; with `forecast_every` above 3
                at 30 Hz, it must be longer than the time between two of them.
            session: a name for this robot's stream of this person: whoever opens it anew takes it
                over from the one before. Drawn if absent.
            joints: names of your joints; another skeleton is refused.
            clock: gives the time of your frames in seconds, where that is not `time.monotonic`.
            form: of the messages; `json` is there to look at them.

        Raises:
            ValueError: an argument is out of its range.
            RuntimeError: the client was closed.
        """
        if self._is_closed:
            raise RuntimeError("the client was closed")
        check_stream(user, hold_s=hold_s, form=form, session=session)
        settings = check_settings(Settings(forecast_every, coverage, version, max_age_s * 1e3))
        options = StreamOptions(
            settings=settings,
            rules=Rules(max_age_s=max_age_s, hold_s=hold_s),
            session=session,
            joints=joints,
            form=form,
            clock=clock,
        )
        stream = Stream(
            Target(self.url, user, self._key),
            options,
            loop=self._start_loop().loop,
            owner=self,
            on_forecast=on_forecast,
            on_event=on_event,
        )
        self._streams.add(stream)
        return stream

    def _start_loop(self) -> OwnLoop:
        with self._lock:
            if self._is_closed:
                raise RuntimeError("the client was closed")
            if self._own is None or not self._own.is_alive:
                self._own = OwnLoop(self.url, self._key)
                weakref.finalize(self, self._own.abandon)
            return self._own

    def _send(self, call: Call[Answer], timeout_s: float | None = None) -> Answer:
        status, headers, content = self._request(call, timeout_s or self._timeout_s)
        return read_answer(status, headers, content, call.read)

    def _request(self, call: Call[Answer], timeout_s: float) -> Response:
        own = self._start_loop()
        return own.ask(own.rest.request(call, timeout_s), timeout_s)
