"""What synchronous and asynchronous streams have in common: everything that waits for nothing."""

import secrets
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal
from uuid import uuid4

import msgspec

from kinecast_client.checks import check_label, check_settings, check_trial
from kinecast_client.clock import Moment
from kinecast_client.core import Core, Phase
from kinecast_client.errors import KinecastError, RecordingError, UnreachableError
from kinecast_client.events import Event
from kinecast_client.forecasts import Forecast, Version
from kinecast_client.frames import Array
from kinecast_client.link import Link, Target
from kinecast_client.messages import Form, Hello, ServiceError, Settings
from kinecast_client.outgoing import Outgoing
from kinecast_client.recordings import RecordingStatus, Taking
from kinecast_client.rules import Rules
from kinecast_client.statistics import Statistics

StreamState = Literal["connecting", "open", "retrying", "stopped", "closed"]
_STATES: dict[Phase, StreamState] = {
    Phase.DIALLING: "connecting",
    Phase.GREETING: "connecting",
    Phase.OPEN: "open",
    Phase.RESTING: "retrying",
    Phase.STOPPED: "stopped",
    Phase.CLOSED: "closed",
}

OVER = frozenset({Phase.STOPPED, Phase.CLOSED})
DECIDED = OVER | {Phase.OPEN}


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamOptions:
    """How a stream behaves; see `Client.stream`."""

    settings: Settings
    rules: Rules
    session: str | None = None
    joints: Sequence[str] | None = None
    form: Form = "msgpack"
    clock: Callable[[], float] = time.monotonic


class StreamBase:
    """A stream of one user. Made by `Client.stream` or `AsyncClient.stream`."""

    def __init__(self, target: Target, options: StreamOptions) -> None:
        self._lock = threading.Lock()
        self._clock = options.clock
        joints = options.joints
        self._core = Core(
            target.user,
            session=options.session or f"client-{secrets.token_hex(8)}",
            form=options.form,
            settings=options.settings,
            rules=options.rules,
            joints=None if joints is None else tuple(joints),
            read_now=self._now,
        )
        self._link = Link(self._core, target, clock=self._clock, lock=self._lock, tell=self._tell)

    def send(
        self, joints: Array | None, t: float | None = None, confidence: Array | None = None
    ) -> int | None:
        """Hand over a frame to be sent. Never waits, whatever the network does.

        Args:
            joints: [J, 3] metres in the order of `joints`, NaN for a missing joint; None for a
                frame without the person. It is copied.
            t: when it was captured, seconds on the stream's `clock`; now if absent.
            confidence: [J] from 0 to 1, absent is 1.

        Returns:
            The frame's number, which its forecast has as `seq`. None where it cannot be sent: the
            time is not above the last one, it comes faster than the service allows, a coordinate is
            infinite or beyond 100 m, or the stream is over. `statistics().refused` counts why.

        Raises:
            FrameError: it has another shape than a frame of this person. Nothing else.
        """
        with self._lock:
            seq = self._core.offer(joints, t, confidence, self._now())
        self._link.wake()
        return seq

    def latest(self) -> Forecast | None:
        """Give the newest forecast that may be used now. Never waits and never raises.

        None where there is none: its newest frame is older than `max_age_s`, it came over `hold_s`
        ago, the stream was reset or reconnected since, or it was closed or stopped.
        """
        with self._lock:
            return self._core.latest(self._now())

    def configure(
        self,
        *,
        forecast_every: int | None = None,
        coverage: float | None = None,
        version: str | int | None = None,
    ) -> None:
        """Change how forecasts are made, now and after every reconnect; what is None stays.

        A version that there is not comes back as an error of the service; see `last_error`.

        Args:
            forecast_every: answer every n-th frame, 1 to 600.
            coverage: probability for `radius`, above 0 and below 1.
            version: `active`, `base` or a number.

        Raises:
            ValueError: an argument is out of its range.
        """
        given = {"forecast_every": forecast_every, "coverage": coverage, "version": version}
        changes = {name: value for name, value in given.items() if value is not None}
        with self._lock:
            wanted = msgspec.structs.replace(self._core.settings, **changes)
            self._core.configure(check_settings(wanted))
        self._link.wake()

    def reset(self) -> None:
        """Forget what was observed: the frame of reference jumped. Never waits.

        No forecast of the frames before is handed out any more.
        """
        with self._lock:
            self._core.outgoing.reset()
        self._link.wake()

    def statistics(self) -> Statistics:
        """Give figures of how the stream has fared until now."""
        with self._lock:
            return self._core.sum_up()

    def check(self) -> None:
        """Raise why the stream stopped, if it did.

        Raises:
            StoppedError: it ended for good.
        """
        error = self._core.stop_error
        if error is not None:
            raise error

    @property
    def state(self) -> StreamState:
        """Where it stands: `connecting`, `open`, `retrying`, `stopped` (for good) or `closed`."""
        return _STATES[self._core.phase]

    @property
    def hello(self) -> Hello | None:
        """What the service said first on the newest connection; None before the first."""
        return self._core.hello

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints, in the order of `send` and of forecasts; empty before the hello."""
        hello = self._core.hello
        return () if hello is None else hello.joints

    @property
    def version(self) -> Version | None:
        """Which weights answer at the moment, None before the hello."""
        return self._core.version

    @property
    def waiting(self) -> str | None:
        """Why frames get no forecast, such as `warm_up`; None where they get one."""
        return self._core.waiting

    @property
    def last_error(self) -> ServiceError | None:
        """The newest error that the service told of, None for none."""
        return self._core.last_error

    @property
    def clock_offset_s(self) -> float | None:
        """The service's clock minus the stream's, to half of a round trip; None before a pong."""
        return self._core.clock.offset_s

    def _now(self) -> Moment:
        return Moment(time.monotonic(), self._clock())

    def _tell(self, events: list[Event]) -> None:
        """Take events off the link's hands, on its thread."""
        raise NotImplementedError

    def _explain_absence(self) -> KinecastError:
        """Say why the stream is not open."""
        is_closed = self._core.phase is Phase.CLOSED
        why = "it was closed" if is_closed else self._core.last_failure or "no answer yet"
        return UnreachableError(f"No stream of {self._core.user}: {why}.")

    def _start_recording(self, trial: str | None, label: str | None) -> Taking:
        label = check_label(label)
        trial = str(uuid4()) if trial is None else check_trial(trial)
        with self._lock:
            taking = self._core.outgoing.taking
            if taking is not None and not taking.status.is_over:
                raise RecordingError(
                    "trial_conflict", f"Trial {taking.status.trial} is being recorded; stop it."
                )
            taking = self._core.outgoing.start_recording(trial, label, self._now())
        self._link.wake()
        return taking


class RecordingBase:
    """What synchronous and asynchronous recordings have in common."""

    def __init__(self, stream: StreamBase, taking: Taking) -> None:
        self._stream, self._taking = stream, taking

    @property
    def trial(self) -> str:
        """Id of the trial, also for `client.trials.get`."""
        return self._taking.status.trial

    @property
    def status(self) -> RecordingStatus:
        """How it stands as far as the service has said; never waits."""
        return self._taking.status

    def clip(self, action: str | None = None) -> None:
        """Begin a clip; `action` names what the person does. Never waits.

        The first clip is there from the start, and is only named while it has no frame.

        Raises:
            ValueError: the name is empty, too long, or has control characters.
        """
        check_label(action)
        self._do(lambda outgoing: outgoing.start_clip(action))

    def pause(self) -> None:
        """End the clip: frames are forecast and not recorded until the next one. Never waits."""
        self._do(lambda outgoing: outgoing.stop_clip())

    def _do(self, act: Callable[[Outgoing], None]) -> None:
        stream = self._stream
        with stream._lock:  # noqa: SLF001 - the two are one
            outgoing = stream._core.outgoing  # noqa: SLF001
            if outgoing.taking is self._taking:
                act(outgoing)
        stream._link.wake()  # noqa: SLF001

    def _judge(self) -> RecordingStatus:
        """Give the status, if it is a good one."""
        status = self._taking.status
        if status.state == "failed":
            raise RecordingError(self._taking.code, status.error or "it failed")
        return status
