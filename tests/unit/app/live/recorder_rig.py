"""A recorder with a database that is a list and may be away."""

import re
from collections.abc import Iterable
from dataclasses import replace
from uuid import UUID

import numpy as np

from app.domain.errors import KinecastError
from app.live.actions import Action, End, Send, Store
from app.live.protocol import ErrorMessage, JobNote, Observation, TrialMessage, TrialStart
from app.live.recorder import Recorder
from app.live.steps import (
    Append,
    Begin,
    Cancel,
    Done,
    Finish,
    Finished,
    LastClip,
    Opened,
    Outcome,
    Resume,
    Step,
    Touch,
)
from tests.unit.app.live.test_session import LIMITS

JOB = JobNote(UUID(int=7), "queued")
SMALL = replace(LIMITS, clips=4, frames_per_clip=40)


class ListArchive:
    """Stores steps in memory; a step that is carried out twice changes nothing."""

    def __init__(self) -> None:
        self.clips: dict[int, list[Observation]] = {}
        self.actions: dict[int, str | None] = {}
        self.state: str | None = None
        self.steps: list[Step] = []

    @property
    def stored_seq(self) -> int | None:
        return max((frame.seq for frames in self.clips.values() for frame in frames), default=None)

    def perform(self, step: Step) -> Outcome:
        self.steps.append(step)
        match step:
            case Begin() | Resume():
                self.state = "recording"
                return self._open()
            case Append(portions=portions):
                for one in portions:
                    if self.stored_seq is None or one.stored_seq > self.stored_seq:
                        self.clips.setdefault(one.clip, []).extend(one.frames)
                        self.actions[one.clip] = one.action
            case Finish(finetune=finetune):
                self.state = "stored"
                return Finished(JOB if finetune else None)
            case Cancel():
                self.state = "cancelled"
                self.clips.clear()
            case Touch():
                assert self.state == "recording"
        return Done()

    def _open(self) -> Opened:
        if not self.clips:
            return Opened()
        ordinal, frames = max(self.clips.items())
        last = LastClip(ordinal, self.actions[ordinal], len(frames), frames[0].t, frames[-1].t)
        count = sum(len(frames) for frames in self.clips.values())
        return Opened(self.stored_seq, count, ordinal + 1, last)


class Rig:
    """A recorder, its archive, and everything that the client was told."""

    def __init__(self, limits=LIMITS, archive: ListArchive | None = None) -> None:
        self.recorder = Recorder(limits, joints=20)
        self.archive = archive or ListArchive()
        self.now = 100.0
        self.waiting: Step | None = None
        self.told: list[TrialMessage | ErrorMessage] = []
        self.ended: KinecastError | None = None

    def take(self, actions: Iterable[Action]) -> None:
        for action in actions:
            if isinstance(action, Store):
                assert self.waiting is None, "two steps at once"
                self.waiting = action.step
            elif isinstance(action, Send):
                self.told.append(action.message)
            elif isinstance(action, End):
                self.ended = action.error

    def say(self, message) -> None:
        self.take(self.recorder.take(message, self.now))

    def show(self, seqs: Iterable[int], *, since: float = 0.0, anew: bool = False) -> None:
        for seq in seqs:
            self.now += 1 / 30
            frame = make_frame(seq, since + seq / 30)
            self.take(self.recorder.record(frame, self.now, anew=anew))
            anew = False

    def answer(self, *, fails: KinecastError | None = None, is_lost: bool = False) -> None:
        """Carry the waiting step out; or fail, having carried it out or not."""
        step, self.waiting = self.waiting, None
        assert step is not None
        outcome = None if fails is not None and not is_lost else self.archive.perform(step)
        if fails is None:
            self.take(self.recorder.wrote(outcome, self.now))
        else:
            self.take(self.recorder.failed(fails, self.now))

    def settle(self) -> None:
        while self.waiting is not None:
            self.answer()

    def tick(self, passed: float = 1.0) -> None:
        self.now += passed
        self.take(self.recorder.tick(self.now))

    @property
    def last(self) -> TrialMessage:
        return next(one for one in reversed(self.told) if isinstance(one, TrialMessage))

    @property
    def codes(self) -> list[str]:
        return [one.code for one in self.told if isinstance(one, ErrorMessage)]

    def stored(self) -> list[list[int]]:
        return [[frame.seq for frame in self.archive.clips[i]] for i in sorted(self.archive.clips)]


def make_frame(seq: int, t: float) -> Observation:
    return Observation(seq, t, np.full((20, 3), 0.5), None, replay=False)


def begin(limits=LIMITS, **fields) -> Rig:
    rig = Rig(limits)
    rig.say(TrialStart(**fields))
    rig.settle()
    return rig


def find_lost(rig: Rig) -> list[int]:
    """The frames of which the client was told that they are lost."""
    lost = []
    for one in rig.told:
        seqs = isinstance(one, ErrorMessage) and re.search(r"frames (\d+) to (\d+)", one.message)
        if seqs:
            lost += range(int(seqs[1]), int(seqs[2]) + 1)
    return lost
