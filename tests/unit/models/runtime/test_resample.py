"""A window on its grid, by the kernel and by numpy alike."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models.runtime import resample as module
from models.runtime.fused import KERNEL
from models.runtime.resample import find_fastest, resample

GRID = -np.arange(14, -1, -1) / 30
needs_kernel = pytest.mark.skipif(KERNEL is None, reason="no kernel was built for this processor")
STEPS = st.lists(
    st.sampled_from([1 / 30, 1 / 30 + 5e-7, 1 / 60, 0.4]) | st.floats(1e-3, 0.5),
    min_size=0,
    max_size=60,
)


def make(steps: list[float]) -> tuple[np.ndarray, np.ndarray]:
    times = 1.7e9 + np.concatenate([[0.0], np.cumsum(steps)])
    return times, np.random.default_rng(len(steps)).normal(size=(len(times), 4, 3))


@needs_kernel
@given(STEPS)
def test_both_ways_give_the_same_numbers(steps: list[float]) -> None:
    times, poses = make(steps)
    poses_there, longest = resample(times, poses, GRID, snap_s=1e-6)
    expected, longest_there = module._resample_by_numpy(times, poses, GRID, 1e-6)
    np.testing.assert_allclose(poses_there, expected, rtol=0, atol=1e-9)
    assert longest == longest_there


@pytest.mark.parametrize("kernel", [KERNEL, None])
def test_frames_at_the_rate_of_the_grid_are_taken_as_they_are(
    kernel: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "KERNEL", kernel)
    times, poses = make([1 / 30] * 20)
    there, longest = resample(times, poses, GRID, snap_s=1e-6)
    np.testing.assert_array_equal(there, poses[-15:])
    assert longest == pytest.approx(1 / 30, abs=1e-6)


@pytest.mark.parametrize("kernel", [KERNEL, None])
def test_the_longest_step_is_one_that_the_window_spans(
    kernel: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "KERNEL", kernel)
    times, poses = make([0.45] + [1 / 30] * 15)
    assert resample(times, poses, GRID, snap_s=1e-6)[1] < 0.04
    times, poses = make([1 / 30] * 5 + [0.45] + [1 / 30] * 10)
    assert resample(times, poses, GRID, snap_s=1e-6)[1] == pytest.approx(0.45, abs=1e-6)


@pytest.mark.parametrize("kernel", [KERNEL, None])
@pytest.mark.parametrize("kind", ["quick", "one", "none", "nan"])
def test_the_fastest_step_is_found(
    kernel: object, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "KERNEL", kernel)
    poses = np.zeros((4, 3, 3))
    poses[2, 1] = 3.0, 0.0, 4.0
    poses[3] = poses[2]
    poses[3, 2, 1] = 1.0
    if kind == "nan":
        poses[1, 0, 0] = np.nan
        assert np.isnan(find_fastest(poses, root=2)[0])
    elif kind == "quick":
        assert find_fastest(poses, root=2) == (25.0, 1.0)
    elif kind == "one":
        assert find_fastest(poses[:1], root=2) == (0.0, 0.0)
    else:
        assert find_fastest(poses[::-1].transpose(0, 1, 2), root=0) == (25.0, 0.0)


@needs_kernel
def test_sizes_that_do_not_fit_are_refused() -> None:
    times, poses = make([1 / 30] * 3)
    assert KERNEL is not None
    with pytest.raises(ValueError, match="do not fit"):
        KERNEL.resample(times[:-1], poses, GRID, 1e-6, np.empty((15, 4, 3)))
    with pytest.raises(ValueError, match="do not fit"):
        KERNEL.resample(times, poses, GRID, 1e-6, np.empty((14, 4, 3)))
