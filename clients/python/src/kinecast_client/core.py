"""What a stream does with everything that happens: no socket, no clock, no thread.

Bytes of the service, frames of the caller and `now` go in; bytes to be sent, events and the newest
usable forecast come out. Whoever carries it out dials when `phase` says so, hands over what comes
(`received`, `lost`), sends what `take` gives, and calls `tick` several times a second.
"""

import math
import random
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from enum import Enum
from hashlib import sha256
from typing import Literal

from kinecast_client import frames
from kinecast_client.clock import Moment, ServerClock
from kinecast_client.errors import FINAL_CLOSES, StoppedError, find_stop
from kinecast_client.events import Connected, Disconnected, Event, Stopped
from kinecast_client.forecasts import Forecast, Version
from kinecast_client.frames import Array
from kinecast_client.greeting import find_flaw, find_refusal
from kinecast_client.incoming import Held, Questions, Sent, find_age, read_forecast
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
from kinecast_client.pace import Pace
from kinecast_client.pulse import Pulse
from kinecast_client.recordings import Taking
from kinecast_client.rules import Rules
from kinecast_client.statistics import Statistics, Tally
from kinecast_client.tape import Frame, Mark, Tape

MAX_MESSAGE_BYTES = 4 * 2**20
MAX_RATE_HZ = 120.0
BROKEN = 1006
_CODES_KEPT = 64
_CONTROLS_KEPT = 32
_RECORDING_ERRORS = ("trial_", "unknown_trial", "forbidden")


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
        self.generation = 0
        self.clock = ServerClock()
        self.taking: Taking | None = None
        self.tally = Tally()
        self.user, self._session, self._joints = user, session, joints
        self._read_now, self._draw = read_now, draw
        self._tape, self._questions = Tape(), Questions()
        self._pace = Pace(MAX_RATE_HZ)
        self._held: Held | None = None
        self._next_seq = 0
        self._last_t: float | None = None
        self._answered_seq = -1
        self._controls: deque[str | bytes] = deque(maxlen=_CONTROLS_KEPT)
        self._pulse = Pulse(self.rules, self.clock, Moment(0.0, 0.0))
        self._failures = 0
        self._since = -math.inf
        self._bye: Bye | None = None
        self._fault: ServiceError | None = None
        self._was_good = False

    # what the caller does

    @property
    def joint_count(self) -> int | None:
        """How many joints a frame has; None before that is known."""
        return None if self._joints is None else len(self._joints)

    def offer(
        self, joints: Array | None, t: float | None, confidence: Array | None, now: Moment
    ) -> int | None:
        """Take a frame to be sent and give its number; None where it cannot be sent.

        Raises:
            FrameError: it has another shape than a frame.
        """
        pose = frames.read_joints(joints, self.joint_count)
        weights = frames.read_confidence(confidence, None if pose is None else len(pose))
        if self.phase in {Phase.STOPPED, Phase.CLOSED}:
            self._refuse("stopped")
            return None
        time = now.frame if t is None else float(t)
        flaw = frames.find_flaw(pose)
        flaw = flaw or frames.find_wrong_time(time, self._last_t, self._max_rate_hz)
        if flaw is not None:
            self._refuse(flaw)
            return None
        if self._last_t is not None and time < self._last_t:
            self._cut()
        seq, self._next_seq, self._last_t = self._next_seq, self._next_seq + 1, time
        recorded = self.taking is not None and self.taking.takes_frames
        self._tape.add(seq, time, pose, weights, now=now.mono, recorded=recorded)
        self.tally.offered += 1
        return seq

    def latest(self, now: Moment) -> Forecast | None:
        """Give the newest forecast that may be used now, None where there is none."""
        held = self._held
        if held is None or not -1e-9 <= now.mono - held.received_at <= self.rules.hold_s:
            return None
        return held.forecast if held.find_age(now) <= self.rules.max_age_s else None

    def configure(self, settings: Settings) -> None:
        """Change how forecasts are made, on this connection and those to come."""
        self.settings = settings
        if self.phase is Phase.OPEN:
            self._configure()

    def reset(self) -> None:
        """Forget the window, here and there: the frame of reference jumped."""
        self._cut()
        self._tape.mark("reset", self._next_seq - 1)

    def start_recording(self, trial: str, label: str | None, now: Moment) -> Taking:
        """Begin to record what is offered from now on; another recording must be over."""
        self.taking = Taking(trial, now=now.mono)
        fields = {"trial": trial} if label is None else {"trial": trial, "label": label}
        self._tape.open_recording("trial.start", **fields)
        return self.taking

    def start_clip(self, action: str | None) -> None:
        """Begin a clip of the recording."""
        self._mark_recording("clip.start", **({} if action is None else {"action": action}))
        self._set_in_clip(is_in=True)

    def stop_clip(self) -> None:
        """End the clip of the recording."""
        self._mark_recording("clip.stop")
        self._set_in_clip(is_in=False)

    def stop_recording(self, *, finetune: bool) -> None:
        """End the recording."""
        self._end_recording("trial.stop", finetune=finetune)

    def cancel_recording(self) -> None:
        """Throw the recording away."""
        self._end_recording("trial.cancel")

    def close(self) -> None:
        """End the stream from our side; one that stopped by itself stays stopped."""
        self._held = None
        if self.phase is not Phase.STOPPED:
            self.phase = Phase.CLOSED

    def sum_up(self) -> Statistics:
        """Give the figures as of now."""
        return self.tally.sum_up(unsent=self._tape.unsent, unrecorded=self._tape.unrecorded)

    # what happens to the connection

    def query(self) -> dict[str, str | int | float]:
        """Give the parameters of the stream's URL."""
        wanted = self.settings
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
        self.phase, self.hang_up, self._since = Phase.DIALLING, None, now.mono
        self._bye = self._fault = None
        self._was_good = False
        self._questions.forget()
        self._controls.clear()
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
        if isinstance(message, WireForecast):
            self._take_forecast(message, now)
            return []
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
        if not self._pace.has_room(now.mono):
            return None
        if self._controls:
            data: str | bytes | None = self._controls.popleft()
        else:
            item = self._tape.take()
            data = None if item is None else self._write(item, now)
        if data is not None:
            self._pace.spend()
        return data

    # how it does that

    @property
    def _max_rate_hz(self) -> float:
        return self._pace.rate_hz

    def _refuse(self, reason: str) -> None:
        self.tally.refused[reason] += 1

    def _cut(self) -> None:
        """Take no forecast any more of what was offered until now."""
        self._held = None
        self._answered_seq = max(self._answered_seq, self._next_seq - 1)
        self._tape.cut()

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
        self.version, self.waiting, self._held = hello.version, None, None
        self.tally.connections += 1
        rate_hz = hello.limits.get("max_rate_hz", MAX_RATE_HZ)
        is_rate = isinstance(rate_hz, int | float) and 0 < rate_hz < math.inf
        self._pace = Pace(float(rate_hz) if is_rate else MAX_RATE_HZ)
        if hello.settings != self.settings:
            self._configure()
        self._tape.rewind(now.mono)
        return [Connected(hello)]

    def _hear(self, message: Message | Other, now: Moment) -> list[Event]:
        match message:
            case Ping():
                self._say("pong", id=message.id, server_t=message.server_t, t=now.frame)
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
                self._note_trial(message, now)
                return [message]
            case _:
                pass
        return []

    def _note(self, message: Waiting | Configured | VersionChanged | JobNews) -> None:
        if isinstance(message, Waiting):
            self.waiting = message.reason
        elif isinstance(message, VersionChanged):
            self.version = message.version

    def _note_error(self, error: ServiceError) -> None:
        self.last_error = self._fault = error
        known = error.code in self.tally.errors or len(self.tally.errors) < _CODES_KEPT
        self.tally.errors[error.code if known else "others"] += 1
        taking = self.taking
        is_ours = error.code.startswith(_RECORDING_ERRORS)
        if is_ours and taking is not None and not taking.status.is_over:
            taking.fail(error)
            self._settle(taking)

    def _note_trial(self, news: TrialNews, now: Moment) -> None:
        taking = self.taking
        if taking is None or news.trial != taking.status.trial or taking.status.is_over:
            return
        taking.hear(news, now.mono)
        self._tape.reopen_recording("trial.resume", trial=news.trial)
        self._tape.confirm(news.stored_seq)
        self._settle(taking)

    def _settle(self, taking: Taking) -> None:
        if taking.status.is_over:
            self._tape.close_recording()

    def _take_forecast(self, message: WireForecast, now: Moment) -> None:
        """Keep a forecast if it may be used; count it in any case."""
        sent = self._questions.find(message.seq)
        if self.hello is None or sent is None:
            self.tally.mismatched += 1
            return
        outcome = read_forecast(self.wire, message, self.hello, sent, read_now=self._read_now)
        if outcome == "malformed":
            self.tally.malformed += 1
        elif not isinstance(outcome, Forecast):
            self.tally.mismatched += 1
        elif message.seq <= self._answered_seq or find_age(sent, now) > self.rules.max_age_s:
            self.tally.late += 1
        else:
            self._hold(Held(outcome, sent, now.mono), message, now)

    def _hold(self, held: Held, message: WireForecast, now: Moment) -> None:
        self._held, self._answered_seq, self.waiting = held, message.seq, None
        self._was_good = True
        self.generation += 1
        tally = self.tally
        tally.forecasts += 1
        tally.skipped += max(0, message.skipped)
        tally.not_due += max(0, message.not_due)
        tally.age_ms.append(held.find_age(now) * 1e3)
        tally.response_ms.append((now.mono - held.sent.offered_at) * 1e3)
        tally.service_ms.append(message.timing.total_ms)

    def _write(self, item: Frame | Mark, now: Moment) -> str | bytes | None:
        """Turn what comes off the tape into a message; None for a frame of another skeleton."""
        if isinstance(item, Mark):
            return self.wire.encode(item.kind, **item.fields)
        if item.joints is not None and len(item.joints) != self.joint_count:
            self._refuse("wrong_joint_count")
            return None
        self.tally.sent += 1
        if not item.replay:
            self._questions.note(item.seq, Sent(item.t, item.offered_at))
            self._pulse.ask(now)
        return self.wire.encode_frame(
            item.seq, item.t, item.joints, item.confidence, replay=item.replay
        )

    def _watch(self, now: Moment) -> None:
        """Ask for signs of life, and give up where there is none."""
        self.hang_up = self.hang_up or self._pulse.find_silence(now)
        ping = self._pulse.ping(now)
        if ping is not None:
            self._say("ping", id=ping, t=now.frame)
        if self.taking is not None and self.taking.is_quiet(now.mono):
            self._tape.repeat_opening()

    def _learn(self, pong: Pong, now: Moment) -> None:
        rtt_s = self._pulse.learn(pong, now)
        if rtt_s is not None:
            self.tally.round_trip_ms.append(rtt_s * 1e3)

    def _configure(self) -> None:
        names = Settings.__struct_fields__
        self._say("configure", **{name: getattr(self.settings, name) for name in names})

    def _say(self, kind: str, **fields: object) -> None:
        self._controls.append(self.wire.encode(kind, **fields))

    def _mark_recording(self, kind: Literal["clip.start", "clip.stop"], **fields: object) -> None:
        self._tape.mark(kind, self._next_seq - 1, **fields)

    def _set_in_clip(self, *, is_in: bool) -> None:
        if self.taking is not None:
            self.taking.in_clip = is_in

    def _end_recording(self, kind: str, **fields: object) -> None:
        if self.taking is not None and not self.taking.status.is_over:
            self._tape.mark(kind, self._next_seq - 1, **fields)
            self.taking.end()

    def _explain(self, reason: str) -> tuple[str, str]:
        """Give the code and the text of why the service closed the connection."""
        error, bye = self._fault, self._bye
        code = bye.reason if bye is not None else reason or "closed"
        if error is not None and (error.code == code or bye is None):
            return error.code, error.message
        return code, "The service closed the stream."

    def _stop(self, error: StoppedError) -> list[Event]:
        self.phase, self.stop_error, self._held = Phase.STOPPED, error, None
        self.last_failure = str(error)
        return [Stopped(error)]


_LIVE = frozenset({Phase.DIALLING, Phase.GREETING, Phase.OPEN})
