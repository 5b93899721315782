import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models.training.config import PretrainConfig, one_cycle


@settings(max_examples=50, deadline=None)
@given(progress=st.floats(0, 1), warm_up=st.floats(0.05, 0.9))
def test_the_cycle_stays_between_nothing_and_its_peak(progress: float, warm_up: float) -> None:
    assert 0 < one_cycle(progress, warm_up=warm_up) <= 1 + 1e-9


def test_the_cycle_rises_to_its_peak_and_falls_to_nearly_nothing() -> None:
    config = PretrainConfig(steps=100, learning_rate=1e-3, warm_up=0.2)
    rates = [config.rate_at(step) for step in range(101)]
    assert rates.index(max(rates)) == 20
    assert rates[:21] == sorted(rates[:21])
    assert rates[20:] == sorted(rates[20:], reverse=True)
    assert rates[-1] < 1e-6


def test_the_adversarial_weight_starts_late_and_rises_to_its_value() -> None:
    config = PretrainConfig(steps=100, adversarial_weight=0.5, adversarial_start=0.1)
    assert [config.adversarial_weight_at(s) for s in (0, 10, 15, 20, 99)] == [0, 0, 0.25, 0.5, 0.5]


def test_settings_that_contradict_each_other_are_refused() -> None:
    with pytest.raises(ValueError, match="must be positive"):
        PretrainConfig(steps=0)
    with pytest.raises(ValueError, match="add up to more than 1"):
        PretrainConfig(shares={"a": 0.7, "b": 0.7})
