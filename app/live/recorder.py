"""The recording of a stream: a state machine without a database and without a clock.

Messages, frames and outcomes of steps go in, actions come out. At most one step is under way at a
time; what comes meanwhile waits. Where the database is away a step is tried again, and forecasts
know nothing of it.
"""

from collections.abc import Callable
from enum import Enum
from uuid import UUID, uuid4

from msgspec import UNSET, UnsetType

from app.domain.errors import (
    FencedError,
    KinecastError,
    NotReadyError,
    TrialConflictError,
    TrialLimitError,
    TrialUnavailableError,
    UserDeletedError,
)
from app.domain.limits import Limits
from app.domain.trials import TrialState
from app.live.actions import Action, End, Send, Store, describe
from app.live.protocol import (
    ClipStart,
    ClipStop,
    JobNote,
    Observation,
    Recording,
    TrialCancel,
    TrialMessage,
    TrialResume,
    TrialStart,
    TrialStop,
)
from app.live.steps import (
    Append,
    Begin,
    Cancel,
    Finish,
    Finished,
    Opened,
    Outcome,
    Over,
    Resume,
    Step,
    Touch,
)
from app.live.tape import Tape

RETRY_S = 1.0
TOUCH_S = 10.0
"""A recording to which nothing is added says this often that its stream is still there."""
HOLE_S = 0.1
"""After a reconnect, a longer hole than this begins a new clip."""
SNAP_S = 1e-3


class _Phase(Enum):
    IDLE = "idle"
    OPENING = "opening"
    RECORDING = "recording"
    CLOSING = "closing"


class Recorder:
    """The recording of one stream.

    Args:
        limits: how long it may get.
        joints: how many a frame has.
        keep_s: how long frames wait for a database that is away, before the oldest are dropped.
        draw_id: makes ids of trials.
    """

    def __init__(
        self,
        limits: Limits,
        *,
        joints: int,
        keep_s: float = 10.0,
        draw_id: Callable[[], UUID] = uuid4,
    ) -> None:
        self._limits, self._joints, self._keep_s = limits, joints, keep_s
        self._draw_id = draw_id
        self._phase = _Phase.IDLE
        self._tape = Tape(Opened(), joints=joints)
        self._opening: Begin | Resume = Begin(UUID(int=0), None)
        self._closing: Finish | Cancel | None = None
        self._ended: TrialMessage | None = None
        self._early: list[tuple[ClipStart | ClipStop | Observation, bool]] = []
        self._floor: int | None = None
        self._may_have_hole = self._is_leaving = self._is_away = False
        self._writing: Step | None = None
        self._opened_at = self._wrote_at = self._retry_at = 0.0

    @property
    def waiting(self) -> int:
        """How many frames are not stored yet."""
        early = sum(isinstance(event, Observation) for event, _ in self._early)
        return early + len(self._tape)

    @property
    def is_settled(self) -> bool:
        """Whether nothing is left that a stream which ends would have to store."""
        return self._phase is _Phase.IDLE or (self._closing is None and not self.waiting)

    @property
    def floor(self) -> int | None:
        """The newest frame that was stored before this stream; None where that does not matter."""
        return None if self._phase is _Phase.IDLE else self._floor

    def take(self, message: Recording, now: float) -> list[Action]:
        """Take a message of the client.

        Raises:
            TrialConflictError: it does not fit to what is being recorded.
            TrialLimitError: the trial has no room for another clip.
        """
        match message:
            case TrialStart(trial=trial, label=label):
                return self._open(Begin(trial or self._draw_id(), label), trial, now)
            case TrialResume(trial=trial):
                return self._open(Resume(trial), trial, now)
            case TrialStop(finetune=finetune):
                return self._close(Finish(finetune), TrialState.STORED, now)
            case TrialCancel():
                return self._close(Cancel(), TrialState.CANCELLED, now)
            case _:
                return self._turn(message, now)

    def record(self, frame: Observation, now: float, *, anew: bool) -> list[Action]:
        """Record a frame that was accepted.

        Args:
            frame: as received.
            now: the server's clock, seconds.
            anew: whether a gap or another clock lies before it.
        """
        if self._closing is not None or self._phase is _Phase.IDLE:
            return []
        if self._phase is _Phase.OPENING:
            self._early.append((frame, anew))
            return []
        told = self._add(frame, now, anew=anew)
        return [*told, *self._pump(now)]

    def cut(self, now: float) -> list[Action]:
        """Begin a new clip: the frame of reference jumped."""
        if self._phase is not _Phase.RECORDING or self._tape.open is None:
            return []
        told = self._renew() if self._tape.open.frames else []
        return [*told, *self._pump(now)]

    def tick(self, now: float) -> list[Action]:
        """Do what is due with the time: about once a second."""
        if self._phase is _Phase.IDLE:
            return []
        if self._phase is _Phase.OPENING:
            too_long = self._writing is None and now - self._opened_at > self._keep_s
            away = TrialUnavailableError("No database: nothing is recorded. Start again later.")
            return self._give_up(away) if too_long else self._pump(now)
        self._tape.close()
        told = self._drop_what_is_old(now)
        return [*told, self._show(), *self._pump(now)]

    def leave(self, now: float) -> list[Action]:
        """Store what there is: the stream ends."""
        self._is_leaving, self._retry_at = True, now
        return self._pump(now)

    def wrote(self, outcome: Outcome, now: float) -> list[Action]:
        """Take note of a step that was carried out."""
        step, self._writing = self._writing, None
        self._is_away, self._wrote_at = False, now
        told: list[Action] = []
        if isinstance(outcome, Opened):
            told = self._begin(outcome, now)
        elif isinstance(outcome, Over):
            told = self._end_again(outcome)
        elif isinstance(outcome, Finished):
            told = self._end(TrialState.STORED, outcome.job)
        elif isinstance(step, Cancel):
            told = self._end(TrialState.CANCELLED, UNSET)
        elif isinstance(step, Append):
            self._tape.confirm()
            told = [self._show()]
        return [*told, *self._pump(now)]

    def failed(self, error: KinecastError, now: float) -> list[Action]:
        """Take note of a step that was not carried out, as far as is known."""
        self._writing = None
        self._tape.give_back()
        if isinstance(error, NotReadyError):
            is_news, self._is_away = not self._is_away, True
            self._retry_at = now + RETRY_S
            message = f"No database: what is recorded waits, for up to {self._keep_s:g} s."
            return [Send(describe(TrialUnavailableError(message)))] if is_news else []
        told = self._give_up(error)
        return [End(error)] if isinstance(error, FencedError | UserDeletedError) else told

    def _open(self, step: Begin | Resume, asked: UUID | None, now: float) -> list[Action]:
        if self._phase is not _Phase.IDLE:
            if self._closing is not None and asked != self._trial:
                raise TrialConflictError(f"Trial {self._trial} is not complete yet.")
            if asked not in {None, self._trial}:
                raise TrialConflictError(f"Trial {self._trial} is being recorded; stop it first.")
            return [self._show()] if self._phase is _Phase.RECORDING else []
        if self._ended is not None and asked == self._ended.trial:
            return [Send(self._ended)]
        self._phase, self._opening, self._opened_at = _Phase.OPENING, step, now
        self._closing, self._ended, self._early = None, None, []
        self._is_away = False  # of an outage that ended another recording nothing was told here
        self._tape, self._floor = Tape(Opened(), joints=self._joints), None
        return self._pump(now)

    def _turn(self, message: ClipStart | ClipStop, now: float) -> list[Action]:
        """Begin or end a clip."""
        if self._phase is _Phase.IDLE or self._closing is not None:
            raise TrialConflictError("No trial is being recorded.")
        if self._phase is _Phase.OPENING:
            self._early.append((message, False))
            return []
        clip = self._tape.open
        if isinstance(message, ClipStop):
            self._tape.end()
        elif clip is None or clip.action != message.action:
            self._check_room()
            self._tape.begin(message.action)
        return [self._show(), *self._pump(now)]

    def _close(self, step: Finish | Cancel, state: TrialState, now: float) -> list[Action]:
        if self._phase is _Phase.IDLE:
            if self._ended is None or self._ended.state != state:
                is_over = self._ended is not None
                why = "The last trial is over." if is_over else "No trial is being recorded."
                raise TrialConflictError(why)
            return [Send(self._ended)]
        if self._closing is not None:
            if type(step) is not type(self._closing):
                raise TrialConflictError(f"Trial {self._trial} is about to end already.")
            return []
        self._closing = step
        self._tape.end()
        if isinstance(step, Cancel):
            self._early.clear()
            self._tape.discard()
        if self._phase is _Phase.RECORDING:
            self._phase = _Phase.CLOSING
        return self._pump(now)

    def _begin(self, opened: Opened, now: float) -> list[Action]:
        """Record what came while the trial was being opened."""
        self._phase = _Phase.RECORDING
        self._tape, self._floor = Tape(opened, joints=self._joints), opened.stored_seq
        self._may_have_hole = opened.last is not None
        if self._tape.open is None:
            self._tape.begin(None)
        closing, self._closing = self._closing, None
        early, self._early = self._early, []
        told: list[Action] = []
        while early:
            event, anew = early.pop(0)
            first = next((one.seq for one, _ in early if isinstance(one, Observation)), None)
            told += self._catch_up(event, now, anew=anew, first=first)
        if closing is not None:
            return [*told, *self._close(closing, TrialState.STORED, now)]
        return [*told, self._show()]

    def _catch_up(
        self,
        event: ClipStart | ClipStop | Observation,
        now: float,
        *,
        anew: bool,
        first: int | None,
    ) -> list[Action]:
        """Do what came while the trial was being opened; `first` is the next frame after it."""
        if isinstance(event, Observation):
            return self._add(event, now, anew=anew)
        try:
            return self._turn(event, now)
        except TrialLimitError as error:
            return [Send(describe(error, first))]

    def _add(self, frame: Observation, now: float, *, anew: bool) -> list[Action]:
        clip = self._tape.open
        is_old = self._floor is not None and frame.seq <= self._floor
        if clip is None or is_old:
            return []
        step = frame.t - clip.last_t
        has_hole = self._may_have_hole and not 0 < step <= HOLE_S + SNAP_S
        self._may_have_hole = False
        told = self._renew(frame.seq) if clip.frames and (anew or has_hole) else []
        if self._tape.open is None:
            return told
        limits = self._limits
        if self._tape.open.frames >= limits.frames_per_clip:
            return [*told, *self._end_at("frames_per_clip", limits.frames_per_clip, frame.seq)]
        if self._tape.bytes >= limits.trial_bytes:
            return [*told, *self._end_at("trial_bytes", limits.trial_bytes, frame.seq)]
        self._tape.add(frame, now)
        return told

    def _renew(self, seq: int | None = None) -> list[Action]:
        """Begin a clip like the one before."""
        action = None if self._tape.open is None else self._tape.open.action
        try:
            self._check_room()
        except TrialLimitError as error:
            self._tape.end()
            return [Send(describe(error, seq)), self._show()]
        self._tape.begin(action)
        return [self._show()]

    def _check_room(self) -> None:
        """Make sure that there may be another clip.

        Raises:
            TrialLimitError: there may not.
        """
        if self._tape.clips >= self._limits.clips:
            message = f"A trial may have {self._limits.clips} clips (clips)."
            raise TrialLimitError(message, limit="clips")

    def _end_at(self, limit: str, most: int, seq: int) -> list[Action]:
        self._tape.end()
        message = f"The clip has ended before frame {seq}: over {most} ({limit})."
        return [Send(describe(TrialLimitError(message, limit=limit), seq)), self._show()]

    def _drop_what_is_old(self, now: float) -> list[Action]:
        lost = self._tape.drop_older_than(now - self._keep_s)
        if not lost:
            return []
        what = f"frames {lost[0].seq} to {lost[-1].seq}"
        message = f"No database for too long: {len(lost)} {what} are missing from the recording."
        return [Send(describe(TrialUnavailableError(message)))]

    def _end(self, state: TrialState, job: JobNote | UnsetType | None) -> list[Action]:
        tape = self._tape
        self._phase, self._closing = _Phase.IDLE, None
        self._ended = TrialMessage(
            state, self._trial, None, tape.stored_seq, tape.clips_dropped, job
        )
        return [Send(self._ended)]

    def _end_again(self, over: Over) -> list[Action]:
        """Tell once more how a trial ended; frames that came meanwhile are recorded nowhere."""
        self._early.clear()
        self._phase, self._closing = _Phase.IDLE, None
        job = UNSET if over.state is TrialState.CANCELLED else over.job
        self._ended = TrialMessage(over.state, self._trial, None, over.stored_seq, 0, job)
        return [Send(self._ended)]

    def _give_up(self, error: KinecastError) -> list[Action]:
        self._phase, self._closing, self._ended = _Phase.IDLE, None, None
        self._early.clear()
        self._tape.discard()
        return [Send(describe(error))]

    def _pump(self, now: float) -> list[Action]:
        """Have the next step carried out, if none is under way."""
        if self._writing is not None or (self._is_away and now < self._retry_at):
            return []
        self._writing = self._find_step(now)
        return [] if self._writing is None else [Store(self._writing)]

    def _find_step(self, now: float) -> Step | None:
        if self._phase in {_Phase.IDLE, _Phase.OPENING}:
            return None if self._phase is _Phase.IDLE else self._opening
        if isinstance(self._closing, Cancel):
            return self._closing
        if self._is_leaving:
            self._tape.close()
        portions = self._tape.take()
        if portions:
            return Append(portions)
        if self._closing is not None:
            return self._closing
        return Touch() if now - self._wrote_at >= TOUCH_S else None

    @property
    def _trial(self) -> UUID:
        return self._opening.trial

    def _show(self) -> Send:
        tape = self._tape
        state, clip = TrialState.RECORDING, tape.number
        return Send(TrialMessage(state, self._trial, clip, tape.stored_seq, tape.clips_dropped))
