"""What a stream does with each message: a state machine without a socket and without a clock.

Messages and `now` go in, actions come out; the route carries them out. Every frame is answered by
a forecast, counted in `skipped` or `not_due`, or covered by a `waiting` or an `error`.
"""

from collections.abc import Callable

from msgspec import UNSET
from msgspec.structs import replace

from app.domain.errors import (
    BadFrameError,
    BadMessageError,
    BadTimeUnitError,
    ForbiddenError,
    IdleError,
    InvalidError,
    KinecastError,
    SeqNotIncreasingError,
    StaleFrameError,
    TooFastError,
    TrialConflictError,
    TrialLimitError,
    UnknownVersionError,
    VersionUnavailableError,
)
from app.domain.limits import FEATURES, Limits
from app.domain.motion import RequestedVersion, VersionStamp
from app.live import protocol
from app.live.accounting import Ledger, RateLimit
from app.live.actions import Action, End, Identity, Send, Submit, Ticket
from app.live.choosing import Chooser
from app.live.clock import ClientClock
from app.live.complaints import REPEAT_S, Complaints
from app.live.forecasting import make_answer
from app.live.frames import WindowRules
from app.live.protocol import (
    ClientMessage,
    ClientPong,
    Configure,
    Configured,
    Control,
    Forecast,
    Hello,
    Observation,
    Ping,
    Pong,
    Recording,
    Rejected,
    Reset,
    ServerPing,
    StreamSettings,
    VersionMessage,
    WaitingMessage,
)
from app.live.recorder import Recorder
from app.live.steps import Outcome
from app.live.telemetry import Telemetry
from app.live.window import FrameBuffer, Waiting, WindowReady
from app.live.work import Choice, EngineRequest, EngineResult
from models.spec import MotionSpec

PING_EVERY_S = 5.0
BURST_S = 2.0
"""A stalled link may deliver this much at once."""
RATE_SLACK = 1.1
LATE_SHARE = 0.5
"""Input older than this share of `max_age_ms` is flagged `late_input`."""


class Session:
    """One stream.

    Args:
        identity: whose stream it is.
        settings: how forecasts are made until the client says otherwise.
        limits: what the client may send.
        resolve: tells what the base says to a request for a version; see `Decoders.resolve`.
        active: what is active for the user, None for the base.
        engine_ms: tells how long forecasts take at the moment.
        telemetry: where to count.
        rules: what counts as a window.
        spec: shape of the task.
        keep_s: how long a recording waits for a database that is away.
        now: the server's monotonic clock, seconds; as in every call.
    """

    def __init__(
        self,
        identity: Identity,
        *,
        settings: StreamSettings,
        limits: Limits,
        resolve: Callable[[RequestedVersion], VersionStamp],
        engine_ms: Callable[[], float],
        telemetry: Telemetry,
        now: float,
        active: Choice | None = None,
        rules: WindowRules | None = None,
        spec: MotionSpec | None = None,
        keep_s: float = 10.0,
    ) -> None:
        self.settings = settings
        self.weights = Chooser(resolve, active)
        self.recorder = Recorder(limits, joints=len(identity.skeleton.joints), keep_s=keep_s)
        self._who, self._limits, self._spec = identity, limits, spec or MotionSpec()
        self._engine_ms, self._telemetry = engine_ms, telemetry
        self._complaints = Complaints(telemetry)
        self._buffer = FrameBuffer(
            identity.skeleton,
            up=identity.up,
            root_relative=identity.root_relative,
            rules=rules,
            spec=self._spec,
        )
        self.sightings = self._buffer.sightings
        self._clock = ClientClock()
        self._ledger = Ledger()
        self._rate = RateLimit(
            rate_hz=RATE_SLACK * limits.max_rate_hz, burst=BURST_S * limits.max_rate_hz
        )
        self._last_seq: int | None = None
        self._until_due = 0
        self._waiting: str | None = None
        self._unit_was_wrong = False
        self._last_heard = self._last_ping = now
        self._pings = 0

    def hello(self) -> Hello:
        """Introduce the server: the first message."""
        who = self._who
        return Hello(
            protocol=protocol.PROTOCOL,
            features=FEATURES,
            session=who.session,
            epoch=who.epoch,
            user=who.user,
            skeleton=who.skeleton.name,
            joints=who.skeleton.joints,
            rate_hz=self._spec.rate_hz,
            observe=self._spec.observe,
            horizon=self._spec.horizon,
            version=self.weights.choose(self.settings.version).stamp,
            settings=self.settings,
            limits=self._limits,
        )

    def receive(self, message: ClientMessage, now: float) -> list[Action]:
        """Take a message of the client."""
        self._last_heard = now
        if not self._rate.take(now):
            rate_hz = self._limits.max_rate_hz
            return [End(TooFastError(f"At most {rate_hz:g} messages a second are read."))]
        if isinstance(message, Observation):
            return self._observe(message, now)
        if not isinstance(message, Rejected):
            return self._control(message, now)
        if isinstance(message.error, BadMessageError):
            return [End(message.error)]
        return self._complaints.refuse(message.error, message.seq, now)

    def answer(self, ticket: Ticket, result: EngineResult, now: float) -> list[Action]:
        """Turn a result of the engine into the message, at the moment at which it can leave.

        Gives an error in its place if it became too old, and nothing if the frame is accounted for
        already or the client's frame of reference or clock has changed since.
        """
        if ticket.turn != self.weights.turn:
            return self._ask_again(ticket)
        age_ms = (now - ticket.born) * 1e3
        if age_ms > self.settings.max_age_ms:
            return self._tell_stale(ticket.seq, age_ms) if self._ledger.drop(ticket.seq) else []
        if result.version.replaces_pinned:
            failed = VersionUnavailableError(f"Version {result.version.requested} failed.")
            return (
                [self._complaints.tell(failed, ticket.seq)] if self._ledger.drop(ticket.seq) else []
            )
        counts = self._ledger.settle(ticket.seq)
        if counts is None:
            return []
        self._telemetry.count_frames("answered")
        self._telemetry.count_frames("skipped", counts.skipped)
        answer = make_answer(
            ticket.ready,
            result,
            skeleton=self._who.skeleton,
            up=self._who.up,
            flags=(*ticket.flags, *self.weights.flag(result.version)),
            spec=self._spec,
        )
        return [
            Send(
                Forecast(
                    seq=ticket.seq,
                    t=ticket.ready.t,
                    age_ms=round(age_ms, 3),
                    frames=answer.frames,
                    t_out=answer.t_out,
                    radius=answer.radius,
                    coverage=answer.coverage,
                    version=answer.version,
                    quality=answer.quality,
                    severity=answer.severity,
                    filled=answer.filled,
                    skipped=counts.skipped,
                    not_due=counts.not_due,
                    timing=answer.timing,
                )
            )
        ]

    def switch(self, choice: Choice) -> list[Action]:
        """Go over to other active weights; forecasts of the old ones are made anew."""
        if not self.weights.switch(choice, requested=self.settings.version):
            return []
        return [Send(VersionMessage(choice.stamp, choice.reason))]

    def tick(self, now: float) -> list[Action]:
        """Do what is due with the time: about once a second."""
        if now - self._last_heard > self._limits.idle_s:
            return [End(IdleError(f"No message for {self._limits.idle_s:g} s."))]
        actions: list[Action] = []
        if now - self._last_ping >= PING_EVERY_S:
            self._last_ping, self._pings = now, self._pings + 1
            actions.append(Send(ServerPing(id=self._pings, server_t=now)))
        late = self._ledger.cover(asked_before=now - REPEAT_S)
        if late is not None:
            need_s = self._buffer.rules.complete_s
            actions.append(Send(WaitingMessage(late.seq, late.t, "overloaded", need_s, need_s)))
        return [*actions, *self._complaints.count(self.recorder.tick(now))]

    def wrote(self, outcome: Outcome | KinecastError, now: float) -> list[Action]:
        """Take note of what came of a step of the recording."""
        if isinstance(outcome, KinecastError):
            return self._complaints.count(self.recorder.failed(outcome, now))
        return self._complaints.count(self.recorder.wrote(outcome, now))

    def _control(self, message: Control, now: float) -> list[Action]:
        """Take a message that is no frame."""
        match message:
            case Configure():
                return self._configure(message, now)
            case Reset():
                return self._reset(now)
            case Ping(id=name, t=t):
                return [Send(Pong(id=name, t=t, server_t=now, engine_ms=self._engine_ms()))]
            case ClientPong():
                if message.id == self._pings:
                    self._clock.pong(server_t=self._last_ping, t=message.t, now=now)
                return []
            case protocol.Auth():
                return self._complaints.refuse(
                    InvalidError("The stream is authorised already."), None, now
                )
            case _:
                return self._record(message, now)

    def _reset(self, now: float) -> list[Action]:
        """Forget the window; forecasts on their way are of the frame of reference before."""
        self._buffer.clear()
        self._ledger.forget()
        self._waiting = None
        return self._complaints.count(self.recorder.cut(now))

    def _record(self, message: Recording, now: float) -> list[Action]:
        if not self._who.may_record:
            error = ForbiddenError("Recording needs a key with the scope record.")
            return self._complaints.refuse(error, None, now)
        try:
            return self.recorder.take(message, now)
        except (TrialConflictError, TrialLimitError) as refused:
            return self._complaints.refuse(refused, None, now)

    def _observe(self, frame: Observation, now: float) -> list[Action]:
        self._telemetry.count_frames("received")
        last = self._last_seq
        if not frame.replay and self.recorder.floor is not None:
            last = max(self.recorder.floor, -1 if last is None else last)
        if last is not None and frame.seq <= last:
            error = SeqNotIncreasingError(f"seq must be above {last}, got {frame.seq}.")
            return self._complaints.refuse(error, frame.seq, now)
        try:
            restart = self._buffer.push(frame.t, frame.joints, frame.confidence)
        except BadFrameError as error:
            return self._complaints.refuse(error, frame.seq, now)
        self._last_seq = frame.seq
        if restart == "clock_restart":
            self._clock.restart()
            self._ledger.forget()
        answers = [] if frame.replay else self._respond(frame, now)
        told = self.recorder.record(frame, now, anew=restart is not None)
        return [*answers, *self._complaints.count(told)]

    def _respond(self, frame: Observation, now: float) -> list[Action]:
        """Have a frame forecast, or say why not."""
        age_ms = self._clock.observe(frame.t, now)
        if self._buffer.time_unit_is_wrong:
            return self._tell_time_unit(frame.seq, now)
        self._unit_was_wrong = False
        if age_ms > self.settings.max_age_ms:  # first, so that a backlog is soon worked off
            return self._tell_stale(frame.seq, age_ms)
        self._buffer.likeness.expect(self.weights.choose(self.settings.version).bones)
        outcome = self._buffer.look()
        if isinstance(outcome, Waiting):
            return self._wait(frame, outcome, now)
        self._waiting = None
        return self._ask(frame, outcome, age_ms, now)

    def _ask(
        self, frame: Observation, ready: WindowReady, age_ms: float, now: float
    ) -> list[Action]:
        if self._until_due > 0:
            self._until_due -= 1
            self._ledger.pass_over()
            self._telemetry.count_frames("not_due")
            return []
        self._until_due = self.settings.forecast_every - 1
        self._ledger.ask(frame.seq, frame.t, now)
        is_late = age_ms > LATE_SHARE * self.settings.max_age_ms
        flags = ("late_input",) if is_late else ()
        born = now - age_ms / 1e3
        return [self._submit(Ticket(frame.seq, ready, flags, born=born, turn=self.weights.turn))]

    def _ask_again(self, ticket: Ticket) -> list[Action]:
        """Have a frame forecast by the new weights; where a newer one waits, it counts as skipped.

        A forecast of the old weights may not leave after the message that announced the new ones.
        """
        if not self._ledger.is_newest(ticket.seq):
            return []
        return [self._submit(replace(ticket, turn=self.weights.turn))]

    def _submit(self, ticket: Ticket) -> Submit:
        wanted = self.settings
        choice = self.weights.choose_for(ticket.ready.flags, wanted.version)
        request = EngineRequest(ticket.ready.window, wanted.version, wanted.coverage, choice)
        return Submit(request, ticket)

    def _wait(self, frame: Observation, waiting: Waiting, now: float) -> list[Action]:
        self._telemetry.count_frames("waiting")
        is_new, self._waiting = waiting.reason != self._waiting, waiting.reason
        if not self._complaints.is_time("waiting", now, is_news=is_new):
            return []
        have_s = round(waiting.have_s, 6)
        return [Send(WaitingMessage(frame.seq, frame.t, waiting.reason, have_s, waiting.need_s))]

    def _configure(self, message: Configure, now: float) -> list[Action]:
        given = {
            name: getattr(message, name)
            for name in StreamSettings.__struct_fields__
            if getattr(message, name) is not UNSET
        }
        try:
            self.weights.choose(given.get("version", self.settings.version))
        except VersionUnavailableError as error:
            return self._complaints.refuse(UnknownVersionError(error.message), None, now)
        self.settings = replace(self.settings, **given)
        self._until_due = 0
        from_seq = 0 if self._last_seq is None else self._last_seq + 1
        return [Send(Configured(self.settings, from_seq))]

    def _tell_stale(self, seq: int, age_ms: float) -> list[Action]:
        """Tell of a stale frame: the link's fault, so it counts as no mistake of the client."""
        self._telemetry.count_frames("stale")
        limit = self.settings.max_age_ms
        return [
            self._complaints.tell(StaleFrameError(f"{age_ms:.0f} ms old, over {limit:g} ms."), seq)
        ]

    def _tell_time_unit(self, seq: int, now: float) -> list[Action]:
        self._telemetry.count_frames("waiting")
        self._waiting = None
        is_news, self._unit_was_wrong = not self._unit_was_wrong, True
        if not self._complaints.is_time("unit", now, is_news=is_news):
            return []
        return [
            self._complaints.tell(BadTimeUnitError("The steps of t are not those of seconds."), seq)
        ]
