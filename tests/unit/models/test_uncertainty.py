import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models.uncertainty import LEVELS, RadiusTable, coverage_of


@pytest.fixture
def distances() -> np.ndarray:
    generator = np.random.default_rng(0)
    growth = np.linspace(0.2, 1.0, 15)[:, None]
    return (np.abs(generator.normal(size=(4000, 15, 20))) * 0.1 * growth).astype(np.float32)


@pytest.mark.parametrize("coverage", [0.3, 0.5, 0.8, 0.88, 0.9, 0.95])
def test_the_radius_covers_what_it_promises(distances: np.ndarray, coverage: float) -> None:
    table = RadiusTable.calibrate(distances[:2000], calibrated_on="half")
    assert abs(coverage_of(distances[2000:], table.radius(coverage)) - coverage) < 0.08
    if coverage in LEVELS:
        assert abs(coverage_of(distances[2000:], table.radius(coverage)) - coverage) < 0.015


@settings(max_examples=30, deadline=None)
@given(low=st.floats(0.01, 0.98), more=st.floats(0.001, 0.5))
def test_more_coverage_never_means_a_smaller_radius(low: float, more: float) -> None:
    generator = np.random.default_rng(1)
    table = RadiusTable.calibrate(
        generator.random((50, 3, 2), dtype=np.float32), calibrated_on="noise"
    )
    assert (table.radius(min(low + more, 0.99)) >= table.radius(low)).all()


@pytest.mark.parametrize("coverage", [0.0, -1.0, 0.995, float("nan")])
def test_a_coverage_that_was_not_measured_is_refused(
    distances: np.ndarray, coverage: float
) -> None:
    table = RadiusTable.calibrate(distances[:100], calibrated_on="few")
    with pytest.raises(ValueError, match="coverage must be"):
        table.radius(coverage)


def test_a_table_that_falls_is_refused() -> None:
    with pytest.raises(ValueError, match="must not fall"):
        RadiusTable(np.array([[[0.2]], [[0.1]]], dtype=np.float32), (0.5, 0.9))
    with pytest.raises(ValueError, match="2 levels"):
        RadiusTable(np.zeros((3, 1, 1), dtype=np.float32), (0.5, 0.9))
