"""A decoder that keeps failing is left alone for a while, and never for good."""

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from app.live.breaker import OPEN_S, TRIP_AFTER, Breaker


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


def trip(breaker: Breaker, sha256: str = "ab") -> None:
    assert [breaker.fail(sha256, "guard") for _ in range(TRIP_AFTER)] == [
        *[False] * (TRIP_AFTER - 1),
        True,
    ]


def test_it_takes_several_failures_in_a_row(clock) -> None:
    breaker = Breaker(clock)
    for _ in range(3):
        for _ in range(TRIP_AFTER - 1):
            assert not breaker.fail("ab", "engine_error")
        breaker.succeed("ab")
    assert breaker.blocks("ab") is None
    assert not breaker.is_failing("ab")


def test_it_says_how_the_decoder_failed_and_blocks_no_other(clock) -> None:
    breaker = Breaker(clock)
    trip(breaker)
    assert breaker.blocks("ab") == "guard"
    assert breaker.blocks("cd") is None
    assert breaker.blocks(None) is None


def test_after_a_while_one_try_decides(clock) -> None:
    breaker = Breaker(clock)
    trip(breaker)
    clock.now += OPEN_S
    assert breaker.blocks("ab") is None
    assert breaker.is_failing("ab")
    assert breaker.fail("ab", "engine_error")
    assert breaker.blocks("ab") == "engine_error"
    clock.now += OPEN_S
    breaker.succeed("ab")
    assert not breaker.is_failing("ab")
    assert not breaker.fail("ab", "guard")


class AnyOrder(RuleBasedStateMachine):
    """Whatever happens, nothing is blocked for longer than it must be, nor without a cause."""

    def __init__(self) -> None:
        super().__init__()
        self.clock = Clock()
        self.breaker = Breaker(self.clock)
        self.in_a_row, self.tripped_at = 0, -1e9

    @rule()
    def fail(self) -> None:
        self.in_a_row += 1
        if self.breaker.fail("ab", "guard"):
            self.tripped_at = self.clock.now

    @rule()
    def succeed(self) -> None:
        self.breaker.succeed("ab")
        self.in_a_row, self.tripped_at = 0, -1e9

    @rule(seconds=st.floats(0, 15))
    def wait(self, seconds: float) -> None:
        self.clock.now += seconds

    @invariant()
    def blocks_as_long_as_it_says(self) -> None:
        blocked = self.breaker.blocks("ab") is not None
        assert blocked == (self.clock.now - self.tripped_at < OPEN_S)
        assert not blocked or self.in_a_row >= TRIP_AFTER


TestAnyOrder = AnyOrder.TestCase
TestAnyOrder.settings = settings(max_examples=50, deadline=None)
