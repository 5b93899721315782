"""Whatever a service does, the client's core stays sane and hands out nothing stale or foreign."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule
from kinecast_client.core import Phase
from kinecast_client.errors import StoppedError
from kinecast_client.forecasts import Forecast
from kinecast_client.messages import Wire

from tests.unit.clients.rig import HORIZON, JOINTS, Rig

MAX_AGE_S, HOLD_S = 0.2, 0.15
PASSING = st.sampled_from([1000, 1001, 1006, 1009, 1011, 4408, 4429])
FINAL = st.sampled_from([4400, 4401, 4409, 4410])
ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8) | st.binary(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner),
    max_leaves=8,
)
MESSAGES = "hello forecast version trial job waiting configured pong ping error bye aurora"
NAMES = (
    "seq t frames t_out radius version epoch joints settings limits rate_hz horizon id server_t "
    "state trial stored_seq code message reason retry_after_s skipped timing severity"
)
TYPES, FIELDS = st.sampled_from(MESSAGES.split()), st.sampled_from(NAMES.split())


class MisbehavingService(RuleBasedStateMachine):
    """A service that tells the truth, lies, stalls, repeats itself and dies, in any order."""

    form = "json"

    def __init__(self) -> None:
        super().__init__()
        self.rig = Rig(self.form)
        self.asked: dict[int, tuple[float, float, int]] = {}
        """Frames that were sent to be answered: their time, when they were offered, where."""
        self.offered: dict[int, float] = {}
        self.cut_below = 0
        self.used = -1
        self.received_at = -math.inf
        self.sent_seqs: list[int] = []
        self.rig.connect()

    # the robot

    @rule(step=st.sampled_from([0.0, 1e-3, 1 / 30, 1 / 30, 1 / 30, 0.3]))
    def offer(self, step: float) -> None:
        rig = self.rig
        rig.now += step
        seq = rig.offer()
        if seq is not None:
            self.offered[seq] = rig.now

    @rule()
    def drain(self) -> None:
        rig = self.rig
        for message in rig.drain():
            assert rig.core.phase is Phase.OPEN
            if message["type"] != "frame":
                continue
            assert self.offered[message["seq"]] <= rig.now
            self.sent_seqs.append(message["seq"])
            if not message.get("replay"):
                moment = (message["t"], self.offered[message["seq"]], rig.core.connection)
                self.asked[message["seq"]] = moment

    @rule(seconds=st.floats(0.0, 3.0))
    def wait(self, seconds: float) -> None:
        self.rig.wait(seconds)

    @rule()
    def reset(self) -> None:
        self.rig.core.outgoing.reset()
        self.cut_below = len(self.offered)

    @rule()
    def record(self) -> None:
        outgoing = self.rig.core.outgoing
        if outgoing.taking is None or outgoing.taking.status.is_over:
            outgoing.start_recording("t", None, self.rig.moment())
        else:
            outgoing.end_recording("trial.stop", finetune=True)

    # the network

    @rule()
    @precondition(lambda self: self.rig.core.phase is Phase.RESTING)
    def dial(self) -> None:
        self.rig.dial()
        self.sent_seqs = []

    @rule(step=st.sampled_from([1, 1, 1, 0, -1]))
    def greet(self, step: int) -> None:
        self.rig.greet(epoch=self._next_epoch() - 1 + step)

    @rule(code=PASSING)
    def lose(self, code: int) -> None:
        before = self.rig.core.phase
        events = self.rig.lose(code)
        assert (self.rig.core.phase is Phase.STOPPED) == (before is Phase.STOPPED)
        if before is Phase.STOPPED:
            assert events == []

    @rule()
    @precondition(lambda self: self.rig.core.phase is not Phase.STOPPED)
    def recover(self) -> None:
        """Do what a link does: hang up, wait, dial again."""
        if self.rig.core.phase is not Phase.RESTING:
            self.rig.lose()
        self.rig.wait(0.1)
        self.sent_seqs = []
        self.rig.connect(epoch=self._next_epoch())
        assert self.rig.core.phase is Phase.OPEN

    @rule(code=FINAL)
    def stop(self, code: int) -> None:
        self.rig.lose(code)

    def _next_epoch(self) -> int:
        return self.rig.core.hello.epoch + 1

    # the service

    @rule(delay=st.sampled_from([0.001, 0.01, 0.1]))
    def converse(self, delay: float) -> None:
        """Do what everybody hopes for."""
        self.offer(1 / 30)
        self.drain()
        if len(self.offered) - 1 in self.asked:
            self._answer(len(self.offered) - 1, delay)

    @rule(data=st.data(), delay=st.sampled_from([0.0, 0.01, 0.15, 0.25]))
    @precondition(lambda self: self.asked)
    def answer(self, data: Any, delay: float) -> None:
        """Answer any frame that was ever asked: in time, late, twice or out of order."""
        self._answer(data.draw(st.sampled_from(sorted(self.asked)[-5:])), delay)

    def _answer(self, seq: int, delay: float) -> None:
        self.rig.now += delay
        before = self.rig.core.generation
        self.rig.answer(seq, self.asked[seq][0])
        if self.rig.core.generation != before:
            self.received_at = self.rig.now

    @rule(seq=st.integers(-2, 300) | st.integers(-(2**63), 2**64 - 1), shift=st.floats(-1e3, 1e3))
    def invent(self, seq: int, shift: float) -> None:
        """Answer a frame that was not asked, or give it another time."""
        self._must_not_be_taken(lambda: self.rig.answer(seq, self.rig.now + 1e-3 + abs(shift)))

    @rule(connection=st.integers(-1, 3), data=st.data())
    @precondition(lambda self: self.asked)
    def haunt(self, connection: int, data: Any) -> None:
        """Say something right on a connection that is gone."""
        if connection == self.rig.core.connection:
            return
        seq = data.draw(st.sampled_from(sorted(self.asked)))
        fields = self.rig.forecast(seq, self.asked[seq][0])
        self._must_not_be_taken(lambda: self.rig.hear("forecast", connection=connection, **fields))

    @rule(kind=TYPES, name=FIELDS, value=ANYTHING, data=st.data())
    def garble(self, kind: str, name: str, value: Any, data: Any) -> None:
        """Say a message in which something is wrong."""
        rig = self.rig
        seq = data.draw(st.sampled_from(sorted(self.asked))) if self.asked else 0
        fields = rig.forecast(seq, rig.now) | {
            "epoch": self._next_epoch(),
            "user": "ada",
            "session": "s",
            "joints": list(JOINTS),
            "reason": "gap",
            "trial": "t",
            "state": "recording",
            name: value,
        }
        before = rig.core.generation
        try:
            message = rig.write(kind, **fields)
        except (ValueError, OverflowError):  # no such number on the wire
            return
        rig.receive(message)
        if rig.core.generation != before:
            self.received_at = rig.now

    @rule(noise=st.binary(max_size=200) | st.text(max_size=200))
    def babble(self, noise: bytes | str) -> None:
        self._must_not_be_taken(lambda: self.rig.receive(noise))

    @rule(part=st.floats(0.0, 1.0))
    @precondition(lambda self: self.asked)
    def cut_short(self, part: float) -> None:
        """Say half of a message."""
        seq = max(self.asked)
        message = self.rig.write("forecast", **self.rig.forecast(seq, self.asked[seq][0]))
        cut = message[: int(part * (len(message) - 1))]
        self._must_not_be_taken(lambda: self.rig.receive(cut))

    @rule()
    def drown(self) -> None:
        """Say something that never ends."""
        giant = "x" * (4 * 2**20 + 1)
        self._must_not_be_taken(
            lambda: self.rig.receive(giant if self.form == "json" else giant.encode())
        )

    def _must_not_be_taken(self, act: Any) -> None:
        before = self.rig.core.generation
        act()
        assert self.rig.core.generation == before

    # what must hold

    @invariant()
    def nothing_stale_or_foreign_is_handed_out(self) -> None:
        forecast = self.rig.latest
        if forecast is None:
            return
        rig = self.rig
        assert isinstance(forecast, Forecast)
        assert rig.core.phase not in {Phase.STOPPED, Phase.CLOSED}
        t, offered_at, connection = self.asked[forecast.seq]
        assert forecast.t_observed == t
        assert rig.now - t <= MAX_AGE_S
        assert rig.now - offered_at <= MAX_AGE_S
        assert rig.now - self.received_at <= HOLD_S
        assert connection == rig.core.connection or rig.core.phase is not Phase.OPEN
        assert forecast.seq >= self.cut_below
        assert forecast.seq >= self.used
        self.used = forecast.seq
        assert forecast.frames.shape == (HORIZON, len(JOINTS), 3)
        assert np.isfinite(forecast.frames).all()
        assert forecast.t == pytest.approx(t + np.arange(1, HORIZON + 1) / 30, abs=1e-4)

    @invariant()
    def numbers_rise_on_every_connection(self) -> None:
        assert self.sent_seqs == sorted(set(self.sent_seqs))

    @invariant()
    def a_stop_has_a_reason_and_is_for_good(self) -> None:
        core = self.rig.core
        assert (core.phase is Phase.STOPPED) == isinstance(core.stop_error, StoppedError)

    @invariant()
    def memory_is_bounded(self) -> None:
        assert len(self.rig.core.outgoing.tape) <= 7201 + 300


class MisbehavingBinaryService(MisbehavingService):
    """The same in msgpack."""

    form = "msgpack"


BOUNDS = settings(
    max_examples=100,
    stateful_step_count=50,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
TestMisbehavingService = MisbehavingService.TestCase
TestMisbehavingService.settings = BOUNDS
TestMisbehavingBinaryService = MisbehavingBinaryService.TestCase
TestMisbehavingBinaryService.settings = BOUNDS


@given(data=st.binary(max_size=400))
def test_bytes_are_read_or_refused(data: bytes) -> None:
    for form in ("json", "msgpack"):
        wire = Wire(form)
        try:
            message = wire.decode(data if form == "msgpack" else data.decode(errors="replace"))
        except ValueError:
            continue
        assert hasattr(message, "__struct_fields__")


@pytest.mark.parametrize("depth", [10, 1000, 100_000])
def test_messages_of_any_depth_are_read_or_refused(depth: int) -> None:
    rig = Rig()
    rig.connect()
    for kind in ("forecast", "aurora"):
        rig.receive(f'{{"type":"{kind}","frames":' + "[" * depth + "]" * depth + "}")
    (seq,) = rig.stream()
    rig.answer(seq)
    assert rig.latest.seq == seq
