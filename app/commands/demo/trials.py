"""When a synthetic person is recorded, and what became of it: the client's part of a trial."""

from app.commands.client.messages import Error, Job, Message, Trial
from app.commands.client.stream import Stream

FIRST_AFTER = 300
"""Frames before the first recording, so that the base is seen at work."""
PAUSE = 300
"""Frames between the end of one job and the next recording."""
LENGTH = 1350
"""Frames of a trial: with clips of a few seconds, enough to learn from and to judge by."""
FINAL = frozenset({"succeeded", "rejected", "failed", "cancelled"})
"""States of a job that has ended."""


class Rehearsals:
    """Records a person again and again: a clip for each action, a job for each trial.

    Attributes:
        recorded: trials that were stored.
        jobs: how their jobs ended, by state.
        told: what happens now, in a word or two; empty for nothing.
    """

    def __init__(self) -> None:
        self.recorded = 0
        self.jobs: dict[str, int] = {}
        self.told = ""
        self._begins_at, self._ends_at = FIRST_AFTER, 0
        self._is_recording = self._is_waiting = self._is_barred = False
        self._action: str | None = None
        self._job: str | None = None
        self._states: dict[str, str] = {}

    async def before_frame(self, stream: Stream, seq: int, action: str) -> None:
        """Send what is due before the frame `seq`, in which the person does `action`.

        Raises:
            ClosedError: the stream ended.
            SilenceError: the server takes nothing.
        """
        if self._is_barred or self._is_waiting:
            return
        if not self._is_recording and seq < self._begins_at:
            return
        if not self._is_recording:
            await stream.send("trial.start")
            self._is_recording, self._ends_at, self._action = True, seq + LENGTH, None
            self.told = "recording"
        if seq >= self._ends_at:
            await stream.send("trial.stop")
            self._is_recording, self._is_waiting = False, True
            self.told = "storing"
        elif action != self._action:
            await stream.send("clip.start", action=action)
            self._action = action

    def hear(self, message: Message, seq: int) -> None:
        """Take note of what the service says while the frame `seq` is due."""
        match message:
            case Trial(state="stored", job=job):
                self.recorded += 1
                self._job = None if job is None else str(job["id"])
                self.told = f"job {self._states.get(self._job or '', 'queued')}"
                if self._job is None or self._states.get(self._job) in FINAL:
                    self._end(seq)
            case Job(id=name, state=state):
                self._states[name] = state
                if name == self._job and self._is_waiting:
                    self.told = f"job {state}"
                    if state in FINAL:
                        self._end(seq)
            case Error(code="forbidden"):
                self._is_barred, self.told = True, ""
            case Error(code="trial_conflict"):
                self.lose(seq)

    def lose(self, seq: int) -> None:
        """Take note of a stream or a recording that was lost; begin another one later."""
        self._is_recording = self._is_waiting = False
        self._begins_at, self._job, self.told = seq + PAUSE, None, ""

    def _end(self, seq: int) -> None:
        if self._job is not None:
            state = self._states[self._job]
            self.jobs[state] = self.jobs.get(state, 0) + 1
        self._is_waiting, self._job, self._begins_at = False, None, seq + PAUSE
