"""What a stream does with everything that happens: no socket, no clock, no thread.

Bytes of the service, frames of the caller and `now` go in; bytes to be sent, events and the newest
usable forecast come out. Whoever carries it out dials when `phase` says so, hands over what comes
(`received`, `lost`), sends what `take` gives, and calls `tick` several times a second.
"""

import math
import random
from collections.abc import Callable
from contextlib import suppress
from enum import Enum
from hashlib import sha256

from kinecast_client.clock import Moment, ServerClock
from kinecast_client.errors import FINAL_CLOSES, StoppedError, find_stop
from kinecast_client.events import Connected, Disconnected, Event, Stopped
from kinecast_client.forecasts import Forecast, Version
from kinecast_client.frames import CLOCK_RESTART_S, Array
from kinecast_client.greeting import find_flaw, find_refusal
from kinecast_client.incoming import Incoming, Sent
from kinecast_client.messages import (
    Bye,
    Configured,
    Form,
    Hello,
    JobNews,
    Message,
    Other,
    Ping,
    Pong,
    ServiceError,
    Settings,
    TrialNews,
    VersionChanged,
    Waiting,
    Wire,
    WireForecast,
)
from kinecast_client.outgoing import MAX_RATE_HZ, Outgoing
from kinecast_client.pulse import Pulse
from kinecast_client.rules import Rules
from kinecast_client.statistics import Statistics, Tally

MAX_MESSAGE_BYTES = 4 * 2**20
BROKEN = 1006
SET_BACK_S = 0.005
_CODES_KEPT = 64
_REFUSED_SETTINGS = frozenset({"bad_configure", "unknown_version"})


class Phase(Enum):
    """Where a stream stands."""

    RESTING = "resting"
    DIALLING = "dialling"
    GREETING = "greeting"
    OPEN = "open"
    STOPPED = "stopped"
    CLOSED = "closed"


class Core:
    """One stream.

    Args:
        user: whose stream.
        session: its name, by which a newer connection fences older ones.
        form: the subprotocol.
        settings: how forecasts are made until `configure` says otherwise.
        rules: when something is too old or dead.
        joints: names that the skeleton must have, None for any.
        read_now: both clocks, for the age of forecasts in the hands of the caller only.
        draw: a random number from 0 to 1, for the jitter.
    """

    def __init__(
        self,
        user: str,
        *,
        session: str,
        form: Form = "msgpack",
        settings: Settings | None = None,
        rules: Rules | None = None,
        joints: tuple[str, ...] | None = None,
        read_now: Callable[[], Moment],
        draw: Callable[[], float] = random.random,
    ) -> None:
        self.phase = Phase.RESTING
        self.connection = 0
        self.hello: Hello | None = None
        self.settings = settings or Settings()
        self.rules = rules or Rules()
        self.wire = Wire(form)
        self.stop_error: StoppedError | None = None
        self.last_error: ServiceError | None = None
        self.last_failure = ""
        self.waiting: str | None = None
        self.version: Version | None = None
        self.hang_up: str | None = None
        self.retry_at = -math.inf
        self.clock, self.tally = ServerClock(), Tally()
        count = None if joints is None else len(joints)
        self.outgoing = Outgoing(self.wire, self.tally, joint_count=count)
        self._incoming = Incoming(self.wire, self.rules, self.tally, read_now=read_now)
        self.user, self._session, self._joints, self._draw = user, session, joints, draw
        self._pulse = Pulse(self.rules, self.clock, Moment(0.0, 0.0))
        self._confirmed: Settings | None = None
        self._failures = 0
        self._since = -math.inf
        self._bye: Bye | None = None
        self._fault: ServiceError | None = None
        self._was_good = False
        self._frame_clock = -math.inf

    @property
    def generation(self) -> int:
        """How many forecasts were accepted: whoever has seen as many waits for the next."""
        return self._incoming.generation

    @property
    def is_over(self) -> bool:
        """Whether nothing happens any more."""
        return self.phase in {Phase.STOPPED, Phase.CLOSED}

    def offer(
        self, joints: Array | None, t: float | None, confidence: Array | None, now: Moment
    ) -> int | None:
        """Take a frame to be sent and give its number; None where it cannot be sent.

        Raises:
            FrameError: it has another shape than a frame.
        """
        if self.is_over:
            self.outgoing.refuse("stopped")
            return None
        self._watch_clock(now)
        floor = self.outgoing.floor
        seq = self.outgoing.offer(joints, t, confidence, now)
        if self.outgoing.floor != floor:
            self.clock.restart()
        return seq

    def latest(self, now: Moment) -> Forecast | None:
        """Give the newest forecast that may be used now, None where there is none."""
        return self._incoming.latest(floor=self.outgoing.floor, now=now)

    def configure(self, settings: Settings) -> None:
        """Change how forecasts are made, on this connection and those to come."""
        self.settings = settings
        if self.phase is Phase.OPEN:
            self._configure()

    def close(self) -> None:
        """End the stream from our side; one that stopped by itself stays stopped."""
        self._incoming.forget_answer()
        if self.phase is not Phase.STOPPED:
            self.phase = Phase.CLOSED

    def sum_up(self) -> Statistics:
        """Give the figures as of now."""
        tape = self.outgoing.tape
        return self.tally.sum_up(unsent=tape.unsent, unrecorded=tape.unrecorded)

    def query(self) -> dict[str, str | int | float]:
        """Give the parameters of the stream's URL, with settings that were accepted if any were."""
        wanted = self._confirmed or self.settings
        given: dict[str, str | int | float] = {
            "session": self._session,
            "version": wanted.version,
            "coverage": wanted.coverage,
            "forecast_every": wanted.forecast_every,
        }
        if self._joints is not None:
            given["layout"] = sha256("\n".join(self._joints).encode()).hexdigest()
        return given

    def dial(self, now: Moment) -> int:
        """Begin a connection and give its number; what comes from older ones is ignored."""
        self.connection += 1
        self.hang_up, self._since = None, now.mono
        if not self.is_over:  # it may have been closed a moment ago, from another thread
            self.phase = Phase.DIALLING
        self._bye = self._fault = None
        self._was_good = False
        self._incoming.forget_questions()
        self.outgoing.dial()
        return self.connection

    def connected(self, connection: int) -> None:
        """Note that the service has accepted the connection; its hello is still to come."""
        if connection == self.connection and self.phase is Phase.DIALLING:
            self.phase = Phase.GREETING

    def lost(self, connection: int, close_code: int, reason: str, now: Moment) -> list[Event]:
        """Note that a connection ended, or could not be made."""
        if connection != self.connection or self.phase not in _LIVE:
            return []
        if close_code in FINAL_CLOSES:
            code, detail = self._explain(reason)
            return self._stop(find_stop(close_code)(close_code, code, detail))
        is_settled = self.phase is Phase.OPEN and now.mono - self._since >= self.rules.settled_s
        self._failures = 1 if self._was_good or is_settled else self._failures + 1
        delay_s = self.rules.find_delay(self._failures, self._draw())
        if self._bye is not None and close_code == 4429:
            delay_s = max(delay_s, min(60.0, self._bye.retry_after_s))
        self.phase, self.retry_at = Phase.RESTING, now.mono + delay_s
        self.last_failure = self.hang_up or reason
        return [Disconnected(close_code, self.last_failure, delay_s)]

    def received(self, connection: int, data: str | bytes, now: Moment) -> list[Event]:
        """Take a message of the service."""
        if connection != self.connection or self.phase not in {Phase.GREETING, Phase.OPEN}:
            return []
        if self.hang_up is not None:
            return []
        message = self._decode(data)
        if message is None:
            return []
        self._pulse.hear()
        if self.phase is Phase.GREETING:
            return self._greet(message, now)
        return self._hear(message, now)

    def tick(self, now: Moment) -> None:
        """Do what is due with the time; sets `hang_up` where the connection is dead."""
        if self.phase in {Phase.DIALLING, Phase.GREETING}:
            if now.mono - self._since > self.rules.open_s:
                self.hang_up = self.hang_up or "no hello in time"
        elif self.phase is Phase.OPEN:
            self._watch(now)

    def take(self, now: Moment) -> str | bytes | None:
        """Give what is to be sent now, None where nothing is or may be."""
        if self.phase is not Phase.OPEN or self.hang_up is not None:
            return None
        message = self.outgoing.take(now)
        if message is None:
            return None
        frame = message.frame
        if frame is not None and not frame.replay:
            self._incoming.ask(frame.seq, Sent(frame.t, frame.offered_at))
            self._pulse.ask(now)
        return message.data

    def _watch_clock(self, now: Moment) -> None:
        """Begin anew where the clock of the frames was set back by less than a restart.

        The service would take what follows for old until it asks for the time again.
        """
        step_s, self._frame_clock = self._frame_clock - now.frame, now.frame
        if SET_BACK_S < step_s <= CLOCK_RESTART_S:
            self.outgoing.set_back()
            self.clock.restart()
            if self.phase is Phase.OPEN:
                self.hang_up = "the clock of the frames was set back"

    def _decode(self, data: str | bytes) -> Message | Other | None:
        if len(data) <= MAX_MESSAGE_BYTES:
            with suppress(ValueError):
                return self.wire.decode(data)
        self.tally.malformed += 1
        return None

    def _greet(self, message: Message | Other, now: Moment) -> list[Event]:
        """Take the hello, or what comes in its place."""
        if isinstance(message, Bye):
            self._bye = message
        elif isinstance(message, ServiceError):
            self._note_error(message)
        elif not isinstance(message, Hello):
            self.hang_up = "something else came before the hello"
        elif (refusal := find_refusal(message, self._joints)) is not None:
            return self._stop(refusal)
        else:
            last, session = self.hello, self._session
            self.hang_up = find_flaw(message, user=self.user, session=session, last=last)
            return [] if self.hang_up else self._open(message, now)
        return []

    def _open(self, hello: Hello, now: Moment) -> list[Event]:
        self.phase, self.hello, self._joints = Phase.OPEN, hello, hello.joints
        self._since, self._pulse = now.mono, Pulse(self.rules, self.clock, now)
        self.version, self.waiting, self._confirmed = hello.version, None, hello.settings
        self._incoming.forget_answer()
        self.tally.connections += 1
        given = hello.limits.get("max_rate_hz", MAX_RATE_HZ)
        is_rate = isinstance(given, int | float) and 1 <= given < math.inf
        rate_hz = float(given) if is_rate else MAX_RATE_HZ
        if hello.settings != self.settings:
            self._configure()
        self.outgoing.rewind(now, joint_count=len(hello.joints), rate_hz=rate_hz)
        return [Connected(hello)]

    def _hear(self, message: Message | Other, now: Moment) -> list[Event]:
        match message:
            case WireForecast():
                self._take_forecast(message, now)
            case Ping():
                self._answer(message, now)
            case Pong():
                self._learn(message, now)
            case Bye():
                self._bye = message
            case Hello():
                self.hang_up = "a second hello"
            case Waiting() | Configured() | VersionChanged() | JobNews():
                self._note(message)
                return [message]
            case ServiceError():
                self._note_error(message)
                return [message]
            case TrialNews():
                self.outgoing.hear_trial(message, now)
                return [message]
            case _:
                pass
        return []

    def _note(self, message: Waiting | Configured | VersionChanged | JobNews) -> None:
        if isinstance(message, Waiting):
            self.waiting = message.reason
        elif isinstance(message, VersionChanged):
            self.version = message.version
        elif isinstance(message, Configured):
            self._confirmed = message.settings

    def _note_error(self, error: ServiceError) -> None:
        self.last_error = self._fault = error
        known = error.code in self.tally.errors or len(self.tally.errors) < _CODES_KEPT
        self.tally.errors[error.code if known else "others"] += 1
        if error.code in _REFUSED_SETTINGS and self._confirmed is not None:
            self.settings = self._confirmed  # or every reconnect would ask for the same again
        self.outgoing.hear_error(error)

    def _take_forecast(self, message: WireForecast, now: Moment) -> None:
        floor = self.outgoing.floor
        if self.hello is not None and self._incoming.take(
            message, self.hello, floor=floor, now=now
        ):
            self._was_good, self.waiting = True, None

    def _watch(self, now: Moment) -> None:
        """Ask for signs of life, and give up where there is none."""
        self.hang_up = self.hang_up or self._pulse.find_silence(now)
        ping = self._pulse.ping(now)
        if ping is not None:
            self.outgoing.say("ping", id=ping, t=now.frame)
        self.outgoing.tick(now)

    def _answer(self, ping: Ping, now: Moment) -> None:
        if not self.clock.is_late(ping.server_t, now):
            self.outgoing.say("pong", id=ping.id, server_t=ping.server_t, t=now.frame)

    def _learn(self, pong: Pong, now: Moment) -> None:
        rtt_s = self._pulse.learn(pong, now)
        if rtt_s is not None:
            self.tally.round_trip_ms.append(rtt_s * 1e3)

    def _configure(self) -> None:
        names = Settings.__struct_fields__
        self.outgoing.say("configure", **{name: getattr(self.settings, name) for name in names})

    def _explain(self, reason: str) -> tuple[str, str]:
        """Give the code and the text of why the service closed the connection."""
        error, bye = self._fault, self._bye
        code = bye.reason if bye is not None else reason or "closed"
        if error is not None and (error.code == code or bye is None):
            return error.code, error.message
        return code, "The service closed the stream."

    def _stop(self, error: StoppedError) -> list[Event]:
        self.phase, self.stop_error = Phase.STOPPED, error
        self._incoming.forget_answer()
        self.last_failure = str(error)
        return [Stopped(error)]


_LIVE = frozenset({Phase.DIALLING, Phase.GREETING, Phase.OPEN})
