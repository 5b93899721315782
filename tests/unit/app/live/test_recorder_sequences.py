"""Any sequence of messages, frames and outages."""

from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, precondition, rule

from app.domain.errors import NotReadyError, TrialConflictError, TrialLimitError
from app.live.protocol import ClipStart, ClipStop, TrialStart, TrialStop
from tests.unit.app.live.recorder_rig import SMALL, Rig, find_lost, make_frame


class Recordings(RuleBasedStateMachine):
    """Whatever is said, and whenever the database is away: no frame twice, none lost in silence."""

    def __init__(self) -> None:
        super().__init__()
        self.rig = Rig(SMALL)
        self.seq, self.t = 0, 0.0
        self.is_started = self.is_open = False
        self.expected: list[int] = []
        self.turns: dict[
            int, int
        ] = {}  # of each frame: how many clips the client had begun or ended
        self.turn = 0
        self.heard = 0

    def hear(self) -> None:
        """Take note of clips that ended at a limit: nothing until the next that is begun."""
        while self.heard < len(self.rig.told):
            one = self.rig.told[self.heard]
            self.heard += 1
            if getattr(one, "code", "") != "trial_limit":
                continue
            over = self.turn if one.seq is None else self.turns[one.seq]
            self.is_open = self.is_open and over != self.turn
            if one.seq is not None:
                self.expected = [
                    seq for seq in self.expected if seq < one.seq or self.turns[seq] != over
                ]

    def say(self, message) -> bool:
        try:
            self.rig.say(message)
        except (TrialConflictError, TrialLimitError):
            return False
        return True

    @rule()
    def start(self) -> None:
        if self.say(TrialStart()) and not self.is_started:
            self.is_started = self.is_open = True

    @rule(action=st.sampled_from([None, "a", "b"]))
    @precondition(lambda self: self.rig.archive.state is not None)
    def clip_start(self, action) -> None:
        if self.say(ClipStart(action)):
            self.is_open, self.turn = True, self.turn + 1
            self.hear()

    @rule()
    def clip_stop(self) -> None:
        if self.say(ClipStop()):
            self.is_open, self.turn = False, self.turn + 1
            self.hear()

    @rule(number=st.integers(1, 30), anew=st.booleans())
    def frames(self, number: int, anew: bool) -> None:
        for i in range(number):
            self.rig.now += 1 / 30
            self.t += 1 / 30
            frame = make_frame(self.seq, self.t)
            self.turns[self.seq] = self.turn
            self.rig.take(self.rig.recorder.record(frame, self.rig.now, anew=anew and i == 0))
            if self.is_open:
                self.expected.append(self.seq)
            self.hear()
            self.seq += 1

    @rule(outcome=st.sampled_from(["ok", "ok", "away", "answer lost"]))
    def database(self, outcome: str) -> None:
        if self.rig.waiting is None:
            return
        fails = None if outcome == "ok" else NotReadyError()
        self.rig.answer(fails=fails, is_lost=outcome == "answer lost")
        self.hear()

    @rule(passed=st.sampled_from([0.1, 1.0, 4.0]))
    def tick(self, passed: float) -> None:
        told = len(self.rig.told)
        self.rig.tick(passed)
        if any("nothing is recorded" in getattr(m, "message", "") for m in self.rig.told[told:]):
            self.is_started = self.is_open = False
            self.expected = []

    @rule()
    def reset(self) -> None:
        self.rig.take(self.rig.recorder.cut(self.rig.now))
        self.hear()

    def teardown(self) -> None:
        rig = self.rig
        for _ in range(3):
            rig.tick(0.5)
            rig.settle()
        self.hear()
        if self.say(TrialStop()):
            rig.settle()
            assert rig.last.state == "stored"
            self.check()

    def check(self) -> None:
        lost = set(find_lost(self.rig))
        clips = self.rig.stored()
        stored = [seq for clip in clips for seq in clip]
        assert stored == sorted(set(stored)), "stored twice, or out of order"
        assert set(stored) <= set(self.expected)
        assert set(self.expected) - set(stored) <= lost
        for clip in clips:
            within = [seq for seq in self.expected if clip[0] <= seq <= clip[-1]]
            assert clip == within, "a hole within a clip"
        assert self.rig.recorder.waiting == 0


TestRecordings = Recordings.TestCase
TestRecordings.settings = hypothesis_settings(
    max_examples=80, stateful_step_count=40, deadline=None
)
