from dataclasses import replace
from datetime import UTC, datetime

import hypothesis.strategies as st
import pytest
from hypothesis import given, settings
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from app.domain.versions import (
    MOVES,
    Activation,
    ActivationKind,
    Standing,
    Verdict,
    Version,
    VersionState,
    find_rollback,
    list_purgeable,
    list_standing,
    may_promote,
    must_withdraw,
)

NOW = datetime(2026, 1, 1, tzinfo=UTC)
FREE = Standing(auto_promote=True, active=0, rolled_back=frozenset())


def make_version(number, *, parent=0, purged=False):
    return Version(
        number=number,
        state=VersionState.RETIRED,
        parent=parent,
        base_sha256="b",
        sha256=f"{number:064d}",
        size=1,
        purged=purged,
        trained_on=(),
        metrics={},
        job_id=None,
        created_at=NOW,
        activated_at=None,
    )


def activate(*numbers):
    return [Activation(number, ActivationKind.PROMOTED) for number in numbers]


def test_every_state_explains_itself_and_has_a_row_in_the_table():
    assert set(MOVES) == set(VersionState)
    assert len({state.meaning for state in VersionState}) == len(VersionState)
    assert all(VersionState.ACTIVE in MOVES[state] for state in VersionState if state != "active")


def test_a_harmful_active_version_gives_way_unless_somebody_took_over():
    active = replace(FREE, active=3)
    back = Verdict.RETURN_TO_BASE
    assert must_withdraw(back, active, parent=3)
    assert not must_withdraw(Verdict.REJECT, active, parent=3)
    assert not must_withdraw(back, active, parent=2)
    assert not must_withdraw(back, FREE, parent=0)
    assert not must_withdraw(back, replace(active, auto_promote=False), parent=3)


def test_winner_against_what_is_active_is_promoted():
    assert may_promote(Verdict.PROMOTE, FREE, parent=0, sha256="a")


@pytest.mark.parametrize(
    ("verdict", "standing", "parent"),
    [
        (Verdict.REJECT, FREE, 0),
        (Verdict.TOO_LITTLE_DATA, FREE, 0),
        (Verdict.PROMOTE, replace(FREE, auto_promote=False), 0),
        (Verdict.PROMOTE, replace(FREE, active=2), 1),
        (Verdict.PROMOTE, replace(FREE, rolled_back=frozenset({"a"})), 0),
    ],
)
def test_others_are_not(verdict, standing, parent):
    assert not may_promote(verdict, standing, parent=parent, sha256="a")


def test_rollback_passes_over_what_was_rolled_back():
    history = activate(1, 2)
    assert find_rollback(history, usable=lambda _: True) == 1
    history += [Activation(1, ActivationKind.ROLLED_BACK), *activate(3)]
    assert find_rollback(history, usable=lambda _: True) == 1
    history += [Activation(1, ActivationKind.ROLLED_BACK)]
    assert find_rollback(history, usable=lambda _: True) == 0


def test_rollback_passes_over_what_has_no_weights_any_more():
    history = activate(1, 2, 3)
    assert find_rollback(history, usable=lambda number: number != 2) == 1
    history.append(Activation(1, ActivationKind.ROLLED_BACK))
    assert list_standing(history) == [1]


def test_base_by_hand_can_be_rolled_back_too():
    history = [*activate(1), Activation(0, ActivationKind.BY_HAND)]
    assert find_rollback(history, usable=lambda _: True) == 1


class AnyHistory(RuleBasedStateMachine):
    """Versions made, promoted and rolled back in any order, with a plain model beside."""

    def __init__(self):
        super().__init__()
        self.history, self.stack, self.made = [], [], 0

    @rule()
    def make_and_promote(self):
        self.made += 1
        self._activate(self.made, ActivationKind.PROMOTED)

    @precondition(lambda self: self.made)
    @rule(data=st.data())
    def promote_by_hand(self, data):
        number = data.draw(st.integers(0, self.made))
        if number != (self.stack[-1] if self.stack else 0):
            self._activate(number, ActivationKind.BY_HAND)

    @rule()
    def roll_back(self):
        target = find_rollback(self.history, usable=lambda _: True)
        self.stack = self.stack[:-1]
        assert target == (self.stack[-1] if self.stack else 0)
        self.history.append(Activation(target, ActivationKind.ROLLED_BACK))

    def _activate(self, number, kind):
        self.history.append(Activation(number, kind))
        self.stack.append(number)

    @invariant()
    def history_alone_tells_what_is_active(self):
        assert list_standing(self.history) == self.stack

    @invariant()
    def a_rollback_never_repeats_what_it_took_back(self):
        if self.stack:
            assert find_rollback(self.history, usable=lambda _: True) in {0, *self.stack[:-1]}


TestAnyHistory = AnyHistory.TestCase
TestAnyHistory.settings = settings(max_examples=40, stateful_step_count=15, deadline=None)


@given(
    parents=st.lists(st.integers(0, 5), max_size=12),
    active=st.integers(0, 12),
    keep=st.integers(0, 5),
    purged=st.sets(st.integers(1, 12)),
)
@settings(max_examples=100, deadline=None)
def test_retention_never_takes_the_active_one_nor_its_parent(parents, active, keep, purged):
    versions = [
        make_version(i + 1, parent=min(parent, i), purged=i + 1 in purged)
        for i, parent in enumerate(parents)
    ]
    gone = list_purgeable(versions, active=active, keep=keep)
    parent = next((v.parent for v in versions if v.number == active), 0)
    assert active not in gone
    assert parent not in gone
    assert not set(gone) & purged
    assert not set(gone) & {v.number for v in versions[len(versions) - keep :]} or keep == 0
    left = [v for v in versions if not v.purged and v.number not in gone]
    assert len(left) <= keep + 2
