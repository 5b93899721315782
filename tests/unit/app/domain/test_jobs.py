from datetime import UTC, datetime, timedelta
from itertools import pairwise
from uuid import UUID

import hypothesis.strategies as st
import pytest
from hypothesis import given, settings
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from app.domain.jobs import (
    FIRST_RETRY_S,
    LONGEST_RETRY_S,
    MAX_ATTEMPTS,
    MOVES,
    JobReason,
    JobState,
    fair_order,
    retry_after,
)

NOW = datetime(2026, 1, 1, tzinfo=UTC)


def test_every_state_explains_itself_and_has_a_row_in_the_table():
    assert set(MOVES) == set(JobState)
    assert len({state.meaning for state in JobState}) == len(JobState)


def test_final_states_are_those_of_the_contract():
    final = {state for state in JobState if state.is_final}
    assert final == {"succeeded", "rejected", "failed", "cancelled"}


class AnyJob(RuleBasedStateMachine):
    """A job that makes any allowed move in any order."""

    def __init__(self):
        super().__init__()
        self.path = [JobState.QUEUED]

    @rule(later=st.sampled_from(JobState))
    def move(self, later):
        if self.path[-1].may_become(later):
            self.path.append(later)

    @invariant()
    def nothing_comes_back_from_the_end(self):
        ends = [i for i, state in enumerate(self.path) if state.is_final]
        assert ends in ([], [len(self.path) - 1])

    @invariant()
    def nothing_goes_back_into_the_queue(self):
        assert JobState.QUEUED not in self.path[1:]

    @invariant()
    def only_a_job_that_ran_has_a_result(self):
        if self.path[-1] in (JobState.SUCCEEDED, JobState.REJECTED, JobState.FAILED):
            assert self.path[-2] is JobState.RUNNING


TestAnyJob = AnyJob.TestCase
TestAnyJob.settings = settings(max_examples=30, stateful_step_count=12, deadline=None)


@given(attempt=st.integers(1, 100))
@settings(max_examples=50, deadline=None)
def test_retries_wait_longer_and_longer_and_then_end(attempt):
    wait = retry_after(attempt)
    assert (wait is None) == (attempt >= MAX_ATTEMPTS)
    if wait is not None:
        assert timedelta(seconds=FIRST_RETRY_S) <= wait <= timedelta(seconds=LONGEST_RETRY_S)
        later = retry_after(attempt + 1)
        assert later is None or later > wait


instants = st.integers(0, 50).map(lambda seconds: NOW + timedelta(seconds=seconds))
waiting = st.tuples(st.none() | instants, instants, st.uuids())


@given(jobs=st.lists(waiting, min_size=2, max_size=8, unique_by=lambda job: job[2]))
@settings(max_examples=100, deadline=None)
def test_who_never_had_a_turn_comes_first_then_who_waited_longest(jobs):
    order = sorted(
        jobs, key=lambda job: fair_order(served_at=job[0], created_at=job[1], job_id=job[2])
    )
    for (served, created, _), (next_served, next_created, _) in pairwise(order):
        if served == next_served:
            assert created <= next_created
        elif served is not None:
            assert next_served is not None
            assert served < next_served


@pytest.mark.parametrize("users", [2, 5])
def test_one_busy_user_gets_every_nth_turn(users):
    busy, calm = 0, range(1, users)
    served = dict.fromkeys(range(users))
    turns = []
    for turn in range(4 * users):
        waiting = [
            (user, fair_order(served_at=served[user], created_at=NOW, job_id=UUID(int=user)))
            for user in (busy, *calm)
        ]
        user = min(waiting, key=lambda item: item[1])[0]
        served[user] = NOW + timedelta(seconds=turn)
        turns.append(user)
    assert turns.count(busy) == 4


def test_who_is_fitted_again_for_a_new_base_holds_nobody_up():
    waits = fair_order(
        served_at=None, created_at=NOW, job_id=UUID(int=1), reason=JobReason.NEW_BASE
    )
    later = NOW + timedelta(days=1)
    records = fair_order(served_at=later, created_at=later, job_id=UUID(int=2))
    assert records < waits
