"""The one thread that computes forecasts, off the event loop.

It takes whoever waits at once, never waits for a batch to fill, and leaves only the newest window
of each stream in its slot. Whatever their versions, windows that wait together are one batch. Who
has waited longest comes first: all have the same time to their deadline, and a newer window keeps
the place of the one that it replaces, so nobody starves.
"""

import threading
import time
from asyncio import AbstractEventLoop
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass

import numpy as np
import structlog
import torch

from app.domain.errors import DrainingError, OverloadedError
from app.domain.motion import Timing
from app.live.decoders import Decoders
from app.live.guard import GuardRules
from app.live.ladder import Ladder, Landing
from app.live.telemetry import Telemetry
from app.live.work import EngineRequest, EngineResult
from models.runtime.mixed import NET_FAILURES
from models.spec import MotionSpec

DEADLINE_MS = 33.0

Done = Callable[[EngineResult], None]
log = structlog.get_logger(__name__)


@dataclass(slots=True)
class _Job:
    """One window, who waits for it, and on which event loop."""

    request: EngineRequest
    on_done: Done
    since: float
    loop: AbstractEventLoop | None


class Slot:
    """The place of one stream in the engine: it holds the newest window only."""

    def __init__(self, engine: "Engine", loop: AbstractEventLoop | None) -> None:
        self._engine, self.loop = engine, loop
        self.job: _Job | None = None

    def put(self, request: EngineRequest, on_done: Done) -> int:
        """Leave a window; an older one that still waits is given up.

        Args:
            request: the window.
            on_done: called with the forecast, on the slot's loop.

        Returns:
            How many windows were given up (0 or 1).
        """
        return self._engine.fill(self, request, on_done)

    def close(self) -> None:
        """Give up what waits."""
        self._engine.empty(self)


class Engine:
    """The forecasting thread of a process.

    Args:
        decoders: the weights.
        telemetry: where to count.
        rules: what a forecast may look like.
        batch: most windows of one batch.
        queue: most single forecasts that may wait.
        threads: threads of torch's arithmetic.
        spec: shape of the task.
    """

    def __init__(
        self,
        decoders: Decoders,
        *,
        telemetry: Telemetry | None = None,
        rules: GuardRules | None = None,
        batch: int = 64,
        queue: int = 256,
        threads: int = 1,
        spec: MotionSpec | None = None,
    ) -> None:
        self.decoders = decoders
        self.telemetry = telemetry or Telemetry()
        self.spec = spec or MotionSpec()
        self._ladder = Ladder(
            decoders, telemetry=self.telemetry, rules=rules or GuardRules(), spec=self.spec
        )
        self._batch, self._queue, self._threads = batch, queue, threads
        self._condition = threading.Condition()
        self._waiting: deque[Slot] = deque()
        self._futures: set[Future[EngineResult]] = set()
        self._stopping = False
        self._warm = threading.Event()
        self._healthy = False
        self._thread = threading.Thread(target=self._live, name="kinecast-engine", daemon=True)
        self._recent_ms = 0.0

    @property
    def is_ready(self) -> bool:
        """Whether a forecast asked for now would be made by the net, and soon."""
        return self._healthy and self._thread.is_alive() and not self._stopping

    @property
    def latency_ms(self) -> float:
        """Recent time from window to forecast, smoothed."""
        return self._recent_ms

    def start(self) -> None:
        """Start the thread; it warms up before it takes work."""
        self._thread.start()

    def wait_ready(self, timeout_s: float) -> bool:
        """Wait until the engine has warmed up; tells whether the net can forecast."""
        return self._warm.wait(timeout_s) and self._healthy

    def stop(self, timeout_s: float = 5.0) -> None:
        """Finish the batch in hand, give up the rest and end the thread."""
        with self._condition:
            self._stopping = True
            self._condition.notify_all()
        if self._thread.is_alive():
            self._thread.join(timeout_s)
        self._give_up()

    def open_slot(self, loop: AbstractEventLoop | None = None) -> Slot:
        """Give a stream its place.

        Args:
            loop: where forecasts are handed over; None: on the engine's own thread.
        """
        return Slot(self, loop)

    def submit(self, request: EngineRequest) -> "Future[EngineResult]":
        """Ask for a single forecast, which nothing supersedes.

        Raises:
            OverloadedError: too many wait already.
            DrainingError: the engine is stopping.
        """
        future: Future[EngineResult] = Future()
        with self._condition:
            self._refuse_when_stopping()
            if len(self._futures) >= self._queue:
                raise OverloadedError("Too many forecasts are waiting.")
            self._futures.add(future)
        future.add_done_callback(self._release)

        def finish(result: EngineResult) -> None:
            if not future.done() and future.set_running_or_notify_cancel():
                future.set_result(result)

        self.fill(self.open_slot(), request, finish)
        return future

    def fill(self, slot: Slot, request: EngineRequest, on_done: Done) -> int:
        """Put a window into a slot; see `Slot.put`.

        Raises:
            DrainingError: the engine is stopping.
        """
        with self._condition:
            self._refuse_when_stopping()
            superseded = slot.job is not None
            if not superseded:
                self._waiting.append(slot)
            slot.job = _Job(request, on_done, time.perf_counter(), slot.loop)
            self._condition.notify()
        return int(superseded)

    def empty(self, slot: Slot) -> None:
        """Take a slot's window out of the queue."""
        with self._condition:
            if slot.job is not None:
                slot.job = None
                self._waiting.remove(slot)

    def _give_up(self) -> None:
        """Tell those who still wait that nothing will come."""
        with self._condition:
            self._stopping = True
            abandoned = [
                future for future in self._futures if future.set_running_or_notify_cancel()
            ]
        for future in abandoned:
            future.set_exception(DrainingError())

    def _release(self, future: "Future[EngineResult]") -> None:
        with self._condition:
            self._futures.discard(future)

    def _refuse_when_stopping(self) -> None:
        if self._stopping:
            raise DrainingError

    def _live(self) -> None:
        torch.set_num_threads(self._threads)
        torch.set_flush_denormal(True)  # decayed weights otherwise slow some processors tenfold
        try:
            self._healthy = self._warm_up()
            self._warm.set()
            while jobs := self._take():
                self._serve(jobs)
        finally:
            self._warm.set()
            self._give_up()

    def _warm_up(self) -> bool:
        """Forecast in every size of batch, so that no caller pays for it; tells if that works."""
        sizes = [1]
        while sizes[-1] < self._batch:
            sizes.append(min(2 * sizes[-1], self._batch))
        shape = (self.spec.observe, self.spec.joints, 3)
        try:
            for size in sizes:
                forecast = self.decoders.forecast(np.zeros((size, *shape)))
                if not np.isfinite(forecast).all():
                    log.error("the net's forecasts are not finite; its weights are damaged")
                    return False
        except NET_FAILURES as error:
            self._ladder.report(error)
            return False
        return True

    def _take(self) -> list[_Job]:
        """Take whoever waits, at least one; nobody when it is time to stop."""
        with self._condition:
            while not self._waiting and not self._stopping:
                self._condition.wait()
            if self._stopping:
                return []
            slots = [self._waiting.popleft() for _ in range(min(len(self._waiting), self._batch))]
            jobs = [slot.job for slot in slots if slot.job is not None]
            for slot in slots:
                slot.job = None
            return jobs

    def _serve(self, jobs: Sequence[_Job]) -> None:
        started = time.perf_counter()
        landings = self._ladder.forecast([job.request for job in jobs])
        ended = time.perf_counter()
        self.telemetry.count_batch(len(jobs))
        ready: dict[AbstractEventLoop | None, list[tuple[Done, EngineResult]]] = {}
        compute_ms = round((ended - started) * 1e3, 3)
        for job, landing in zip(jobs, landings, strict=True):
            timing = Timing(
                queue_ms=round((started - job.since) * 1e3, 3),
                compute_ms=compute_ms,
                total_ms=round((ended - job.since) * 1e3, 3),
            )
            self._recent_ms += 0.1 * (timing.total_ms - self._recent_ms)
            self.telemetry.count_forecast(timing, landing.version, deadline_ms=DEADLINE_MS)
            result = _to_result(job.request, landing, timing)
            ready.setdefault(job.loop, []).append((job.on_done, result))
        for loop, results in ready.items():
            self._deliver(loop, results)

    def _deliver(
        self, loop: AbstractEventLoop | None, results: Sequence[tuple[Done, EngineResult]]
    ) -> None:
        """Hand a batch over; a loop is woken once for all of it."""
        try:
            if loop is None:
                _hand_over(results)
            else:
                loop.call_soon_threadsafe(_hand_over, results)
        except RuntimeError:  # the event loop that waited for it is closed
            log.warning("nobody waits for a forecast any more")


def _hand_over(results: Sequence[tuple[Done, EngineResult]]) -> None:
    for on_done, result in results:
        on_done(result)


def _to_result(request: EngineRequest, landing: Landing, timing: Timing) -> EngineResult:
    return EngineResult(
        displacement=landing.displacement,
        radius=landing.radius,
        coverage=request.coverage,
        version=landing.version,
        timing=timing,
        flags=landing.flags,
    )
