"""A window on its grid, by the kernel and by numpy alike."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models.runtime import resample as module
from models.runtime.fused import KERNEL
from models.runtime.resample import Survey, find_fastest, survey

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


def look(times: np.ndarray, poses: np.ndarray, *, start: int = 0) -> Survey:
    facts = np.cumsum(poses[:, :2, 0], axis=0)
    return survey(times, poses, facts, (start, len(times)), GRID, snap_s=1e-6, recent_s=1.0)


@needs_kernel
@given(STEPS, st.integers(0, 60))
def test_both_ways_give_the_same_numbers(steps: list[float], start: int) -> None:
    times, poses = make(steps)
    start = min(start, len(steps))
    found = look(times, poses, start=start)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "KERNEL", None)
        expected = look(times, poses, start=start)
    np.testing.assert_allclose(found.poses, expected.poses, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.means, expected.means, rtol=0, atol=1e-12)
    assert (found.longest_s, found.earlier, found.tops) == (
        expected.longest_s,
        expected.earlier,
        expected.tops,
    )


@pytest.mark.parametrize("kernel", [KERNEL, None])
def test_frames_at_the_rate_of_the_grid_are_taken_as_they_are(
    kernel: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "KERNEL", kernel)
    times, poses = make([1 / 30] * 20)
    found = look(times, poses)
    np.testing.assert_array_equal(found.poses, poses[-15:])
    assert found.longest_s == pytest.approx(1 / 30, abs=1e-6)


@pytest.mark.parametrize("kernel", [KERNEL, None])
def test_the_longest_step_is_one_that_the_window_spans(
    kernel: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "KERNEL", kernel)
    assert look(*make([0.45] + [1 / 30] * 15)).longest_s < 0.04
    spanned = look(*make([1 / 30] * 5 + [0.45] + [1 / 30] * 10))
    assert spanned.longest_s == pytest.approx(0.45, abs=1e-6)


@pytest.mark.parametrize("kernel", [KERNEL, None])
def test_the_last_second_is_summed_up(kernel: object, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "KERNEL", kernel)
    times, facts = np.arange(41) / 20, np.stack([np.arange(41.0), -np.arange(41.0)], axis=1)
    poses = np.zeros((41, 1, 3))
    found = survey(times, poses, facts, (5, 40), GRID, snap_s=1e-6, recent_s=1.0)
    assert found[2:] == (14, (29.0, -29.0), (39.0, -19.0))


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
    facts, out = np.zeros((4, 2)), np.empty((15, 4, 3))
    assert KERNEL is not None
    for wrong in (
        (times[:-1], poses, facts, 0, 3, GRID, 1e-6, 1.0, out),
        (times, poses, facts, 0, 4, GRID, 1e-6, 1.0, out[:-1]),
        (times, poses, facts[:-1], 0, 4, GRID, 1e-6, 1.0, out),
        (times, poses, facts, 0, 5, GRID, 1e-6, 1.0, out),
        (times, poses, facts, -1, 4, GRID, 1e-6, 1.0, out),
        (times, poses, facts, 4, 4, GRID, 1e-6, 1.0, out),
    ):
        with pytest.raises(ValueError, match="do not fit"):
            KERNEL.survey(*wrong)
