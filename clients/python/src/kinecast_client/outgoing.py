"""What is on its way to the service: frames in their order, recordings, and plain messages."""

from collections import deque
from typing import NamedTuple

from kinecast_client import frames
from kinecast_client.clock import Moment
from kinecast_client.frames import Array
from kinecast_client.messages import ServiceError, TrialNews, Wire
from kinecast_client.pace import Pace
from kinecast_client.recordings import Taking
from kinecast_client.statistics import Tally
from kinecast_client.tape import Frame, Tape

MAX_RATE_HZ = 120.0
SEQ_MAX = 2**53 - 1
_CONTROLS_KEPT = 32
_RECORDING_ERRORS = ("trial_", "unknown_trial", "forbidden")


class Message(NamedTuple):
    """What is to be sent, and the frame that it is, if it is one."""

    data: str | bytes
    frame: Frame | None = None


class Outgoing:
    """What is on its way to the service.

    Attributes:
        joint_count: how many joints a frame has, None before that is known.
        floor: no forecast of a frame below this number is wanted any more.
        taking: the newest recording, None before the first.
    """

    def __init__(self, wire: Wire, tally: Tally, *, joint_count: int | None) -> None:
        self.joint_count = joint_count
        self.floor = 0
        self.taking: Taking | None = None
        self.tape = Tape()
        self._wire, self._tally = wire, tally
        self._pace = Pace(MAX_RATE_HZ)
        self._controls: deque[str | bytes] = deque(maxlen=_CONTROLS_KEPT)
        self._next_seq = 0
        self._last_t: float | None = None

    def offer(
        self, joints: Array | None, t: float | None, confidence: Array | None, now: Moment
    ) -> int | None:
        """Take a frame to be sent and give its number; None where it cannot be sent.

        Raises:
            FrameError: it has another shape than a frame.
        """
        pose = frames.read_joints(joints, self.joint_count)
        weights = frames.read_confidence(confidence, None if pose is None else len(pose))
        time = now.frame if t is None else frames.read_time(t)
        flaw = frames.find_flaw(pose)
        flaw = flaw or frames.find_wrong_time(time, self._last_t, self._pace.rate_hz)
        if flaw is not None:
            self.refuse(flaw)
            return None
        if self._last_t is not None and time < self._last_t:
            self._cut()
        seq, self._next_seq, self._last_t = self._next_seq, self._next_seq + 1, time
        recorded = self.taking is not None and self.taking.takes_frames
        self.tape.add(seq, time, pose, weights, now=now.mono, recorded=recorded)
        self._tally.offered += 1
        return seq

    def refuse(self, reason: str) -> None:
        """Count a frame that is not sent."""
        self._tally.refused[reason] += 1

    def reset(self) -> None:
        """Forget the window, here and there."""
        self._cut()
        self.tape.mark("reset", self._next_seq - 1)

    def set_back(self) -> None:
        """Go on from an earlier time: the clock of the frames was set back."""
        self._last_t = None
        self._cut()

    def say(self, kind: str, **fields: object) -> None:
        """Send a message before all frames, on this connection only."""
        self._controls.append(self._wire.encode(kind, **fields))

    def dial(self) -> None:
        """Forget what was to be said on the connection before."""
        self._controls.clear()

    def rewind(self, now: Moment, *, joint_count: int, rate_hz: float) -> None:
        """Begin with a connection that is open: what it needs to know is sent again."""
        self.joint_count, self._pace = joint_count, Pace(rate_hz)
        self.tape.rewind(now.mono)

    def take(self, now: Moment) -> Message | None:
        """Give what is to be sent now, None where nothing is or may be."""
        if not self._pace.has_room(now.mono):
            return None
        message = Message(self._controls.popleft()) if self._controls else self._take_item()
        if message is not None:
            self._pace.spend()
        return message

    def start_recording(self, trial: str, label: str | None, now: Moment) -> Taking:
        """Begin to record what is offered from now on."""
        self.taking = Taking(trial, now=now.mono)
        fields = {"trial": trial} if label is None else {"trial": trial, "label": label}
        self.tape.open_recording("trial.start", **fields)
        return self.taking

    def start_clip(self, action: str | None) -> None:
        """Begin a clip of the recording."""
        self._turn("clip.start", is_in=True, **({} if action is None else {"action": action}))

    def stop_clip(self) -> None:
        """End the clip of the recording."""
        self._turn("clip.stop", is_in=False)

    def end_recording(self, kind: str, **fields: object) -> None:
        """End the recording by `trial.stop` or `trial.cancel`."""
        taking = self.taking
        if taking is not None and not taking.status.is_over:
            taking.end(lambda: self.tape.mark(kind, self._next_seq - 1, **fields))

    def hear_trial(self, news: TrialNews, now: Moment) -> None:
        """Take note of how the recording stands."""
        taking = self.taking
        if taking is None or news.trial != taking.status.trial or taking.status.is_over:
            return
        taking.hear(news, now.mono)
        self.tape.reopen_recording("trial.resume", trial=news.trial)
        self.tape.confirm(news.stored_seq)
        if news.stored_seq is not None and self._next_seq <= news.stored_seq < SEQ_MAX:
            self._next_seq = news.stored_seq + 1  # it was begun by another program
        self._settle(taking)

    def hear_error(self, error: ServiceError) -> None:
        """Take note of an error, if it is about the recording."""
        taking = self.taking
        is_ours = error.code.startswith(_RECORDING_ERRORS)
        if is_ours and taking is not None and not taking.status.is_over:
            taking.fail(error)
            self._settle(taking)

    def tick(self, now: Moment) -> None:
        """Ask how the recording stands, where the service says nothing of it."""
        if self.taking is not None and self.taking.is_quiet(now.mono):
            self.tape.repeat_opening()
            self.taking.repeat_end()

    def _take_item(self) -> Message | None:
        """Give the next frame, or what has its place between frames."""
        while (item := self.tape.take()) is not None:
            if not isinstance(item, Frame):
                return Message(self._wire.encode(item.kind, **item.fields))
            if item.joints is None or len(item.joints) == self.joint_count:
                self._tally.sent += 1
                return Message(self._encode(item), item)
            self.refuse("wrong_joint_count")  # it came before the hello
        return None

    def _encode(self, frame: Frame) -> str | bytes:
        return self._wire.encode_frame(
            frame.seq, frame.t, frame.joints, frame.confidence, replay=frame.replay
        )

    def _turn(self, kind: str, *, is_in: bool, **fields: object) -> None:
        if self.taking is not None and not self.taking.status.is_over:
            self.tape.mark(kind, self._next_seq - 1, **fields)
            self.taking.in_clip = is_in

    def _cut(self) -> None:
        self.floor = self._next_seq
        self.tape.cut()

    def _settle(self, taking: Taking) -> None:
        if taking.status.is_over:
            self.tape.close_recording()
