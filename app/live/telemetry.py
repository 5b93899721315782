"""What operators can see of the live flow: one registry per application, no label names a user."""

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest

from app.domain.motion import Timing, VersionStamp
from app.live.tallies import Spread, Tally

LATENCY_BUCKETS_MS = (1, 2, 5, 10, 20, 33, 50, 100, 200)
BATCH_BUCKETS = (1, 2, 4, 8, 16, 32, 64, 128)


class Telemetry:
    """The metrics of one application."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        self._latency = Spread(
            "kinecast_forecast_latency_ms",
            "Milliseconds from a window to its forecast: waiting, computing, both.",
            "stage",
            values=("queue", "compute", "total"),
            bounds=LATENCY_BUCKETS_MS,
            registry=self.registry,
        )
        self._batch = Histogram(
            "kinecast_engine_batch_size",
            "Windows that were forecast together.",
            buckets=BATCH_BUCKETS,
            registry=self.registry,
        )
        self._misses = self._count("kinecast_deadline_misses", "Forecasts that took over 33 ms.")
        self._forecasts = self._tally(
            "kinecast_forecasts", "Forecasts by the kind of weights.", "kind"
        )
        self._fallbacks = self._count(
            "kinecast_fallbacks", "Forecasts from other weights than asked for.", "reason"
        )
        self._trips = self._count(
            "kinecast_decoder_trips",
            "Times that a personal decoder kept failing and was passed over.",
        )
        self._frames = self._tally("kinecast_frames", "Frames that streams sent, by fate.", "fate")
        self._errors = self._count("kinecast_errors", "Errors that streams were told.", "code")
        self._closed = self._count(
            "kinecast_streams_closed", "Streams that ended or were refused.", "close_code"
        )
        self._open = Gauge(
            "kinecast_streams_open", "Streams that are open now.", registry=self.registry
        )

    def _count(self, name: str, meaning: str, *labels: str) -> Counter:
        return Counter(name, meaning, labels, registry=self.registry)

    def _tally(self, name: str, meaning: str, label: str) -> Tally:
        return Tally(name, meaning, label, registry=self.registry)

    def count_forecast(self, timing: Timing, stamp: VersionStamp, *, deadline_ms: float) -> None:
        """Count one forecast of the engine, on its thread."""
        self._latency.observe("queue", timing.queue_ms)
        self._latency.observe("compute", timing.compute_ms)
        self._latency.observe("total", timing.total_ms)
        if timing.total_ms > deadline_ms:
            self._misses.inc()
        self._forecasts.add(stamp.kind)
        if stamp.fallback is not None:
            self._fallbacks.labels(stamp.fallback).inc()

    def count_trip(self) -> None:
        """Count a personal decoder out that keeps failing."""
        self._trips.inc()

    def count_batch(self, size: int) -> None:
        """Count one batch of the engine."""
        self._batch.observe(size)

    def count_frames(self, fate: str, number: int = 1) -> None:
        """Count frames: `received`, `answered`, `skipped`, `not_due`, `stale` or `waiting`.

        Only on the event loop's thread.
        """
        if number:
            self._frames.add(fate, number)

    def count_error(self, code: str) -> None:
        """Count one error that a stream was told."""
        self._errors.labels(code).inc()

    def stream_opened(self) -> None:
        """Count a stream in."""
        self._open.inc()

    def stream_closed(self) -> None:
        """Count a stream out."""
        self._open.dec()

    def count_close(self, close_code: int) -> None:
        """Count a close code, whether the stream had opened or was refused."""
        self._closed.labels(str(close_code)).inc()

    def render(self) -> bytes:
        """Give everything in the text format of Prometheus."""
        return generate_latest(self.registry)
