"""Operators see the same as of prometheus_client's own."""

from hypothesis import given
from hypothesis import strategies as st
from prometheus_client import CollectorRegistry, Counter, Histogram, generate_latest

from app.live.tallies import Spread, Tally

BOUNDS = (1, 5, 33)


def render(registry: CollectorRegistry) -> list[str]:
    """What is shown, without the times of creation."""
    return [
        line for line in generate_latest(registry).decode().splitlines() if "_created" not in line
    ]


@given(st.lists(st.tuples(st.sampled_from("ab"), st.integers(0, 9))))
def test_counts(counts: list[tuple[str, int]]) -> None:
    ours, theirs = CollectorRegistry(), CollectorRegistry()
    tally = Tally("frames", "Frames.", "fate", registry=ours)
    counter = Counter("frames", "Frames.", ["fate"], registry=theirs)
    for fate, number in counts:
        tally.add(fate, number)
        counter.labels(fate).inc(number)
    assert render(ours) == render(theirs)


@given(
    st.lists(st.tuples(st.sampled_from("ab"), st.sampled_from([0.0, 1.0, 1.5, 5.0, 33.0, 33.5])))
)
def test_distributions(amounts: list[tuple[str, float]]) -> None:
    ours, theirs = CollectorRegistry(), CollectorRegistry()
    spread = Spread("ms", "Time.", "stage", values=("a", "b"), bounds=BOUNDS, registry=ours)
    histogram = Histogram("ms", "Time.", ["stage"], buckets=BOUNDS, registry=theirs)
    for stage in "ab":
        histogram.labels(stage)
    for stage, amount in amounts:
        spread.observe(stage, amount)
        histogram.labels(stage).observe(amount)
    assert sorted(render(ours)) == sorted(render(theirs))
