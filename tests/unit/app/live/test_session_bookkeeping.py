"""Every frame of any stream has one fate."""

import numpy as np
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from app.live.actions import Action, End, Submit
from app.live.protocol import Configure, ErrorMessage, Forecast, Reset, WaitingMessage
from tests.unit.app.live.test_session import frame, make_session, result, sent


class Bookkeeping(RuleBasedStateMachine):
    """Whatever a client does, every frame is answered, counted, or covered by a message."""

    @initialize()
    def begin(self) -> None:
        self.now = 100.0
        self.session = make_session()
        self.seq = -1
        self.t = 0.0
        self.engine: list[Submit] = []
        self.answered = self.skipped = self.not_due = self.refused = self.covered = 0
        self.accepted = 0
        self.last_seq = -1
        self.over = False

    def take(self, actions: list[Action], *, a_frame: bool = False) -> None:
        if a_frame and not actions:
            self.covered += 1  # not due, or covered by a `waiting` before: told apart at the end
        for action in actions:
            if isinstance(action, Submit):
                self.engine.append(action)
            elif isinstance(action, End):
                self.over = True
            else:
                self.note(action.message)

    def note(self, message: object) -> None:
        if isinstance(message, Forecast):
            assert message.seq > self.last_seq
            self.last_seq = message.seq
            self.answered += 1
            self.skipped += message.skipped
            self.not_due += message.not_due
            assert np.isfinite(message.frames).all()
            assert message.age_ms <= self.session.settings.max_age_ms
        if isinstance(message, ErrorMessage) and message.seq is not None:
            self.refused += 1

    @rule(
        step=st.sampled_from([1 / 30, 1 / 30, 1 / 30, 0.08, 0.3, 0.7, -0.01, -3.0]),
        delay=st.sampled_from([0.0, 1 / 30, 1 / 30, 0.3]),
        lost=st.sampled_from([False] * 9 + [True]),
        repeat=st.sampled_from([False] * 9 + [True]),
        times=st.integers(1, 20),
    )
    def send_frames(self, step: float, delay: float, lost: bool, repeat: bool, times: int) -> None:
        for _ in range(times):
            if self.over:
                return
            self.now += delay
            self.t += step
            self.seq += 0 if repeat else 1
            before = self.refused
            one = frame(max(self.seq, 0), self.t, lost=lost)
            actions = self.session.receive(one, self.now)
            self.take(actions, a_frame=True)
            waited = any(isinstance(m, WaitingMessage) for m in sent(actions))
            submitted = any(isinstance(action, Submit) for action in actions)
            self.accepted += submitted
            # one frame, one fate
            assert submitted + waited + (self.refused - before) + (not actions) + self.over >= 1
            if step < 0:
                self.t = max(self.t, self.t - step) if step > -1 else self.t
            step = 1 / 30

    @rule(which=st.integers(0, 30), later=st.sampled_from([0.0, 0.001, 0.25]))
    def engine_answers(self, which: int, later: float) -> None:
        """The engine gives up what was superseded, and answers in order."""
        if self.over or not self.engine:
            return
        which = min(which, len(self.engine) - 1)
        chosen, self.engine = self.engine[which], self.engine[which + 1 :]
        self.now += later
        self.take(self.session.answer(chosen.ticket, result(), self.now))

    @rule(every=st.integers(1, 4))
    def configure(self, every: int) -> None:
        if not self.over:
            self.take(self.session.receive(Configure(forecast_every=every), self.now))

    @rule()
    def reset(self) -> None:
        if not self.over:
            self.take(self.session.receive(Reset(), self.now))

    @rule(passed=st.sampled_from([0.1, 1.1]))
    def tick(self, passed: float) -> None:
        if not self.over:
            self.now += passed
            self.take(self.session.tick(self.now))

    @invariant()
    def nothing_is_counted_twice(self) -> None:
        if hasattr(self, "seq"):
            assert self.answered + self.skipped <= self.accepted
            assert self.not_due <= self.covered


TestBookkeeping = Bookkeeping.TestCase
TestBookkeeping.settings = hypothesis_settings(
    max_examples=40, stateful_step_count=30, deadline=None
)
