"""A stream sees the same by the kernel and by numpy, whatever comes."""

from contextlib import contextmanager

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from app.domain.errors import BadFrameError
from app.live import frames, guard
from app.live.window import FrameBuffer, Waiting, WindowReady
from models.data.synthetic import SyntheticPerson
from models.runtime import resample
from models.runtime.fused import KERNEL
from models.skeleton import KINECT_V1, SKELETONS

pytestmark = pytest.mark.skipif(KERNEL is None, reason="no kernel was built for this processor")
PERSON = SyntheticPerson(3).record("walk", 5.0).astype(np.float64)
KINDS = ("whole", "whole", "whole", "hole", "sure", "unsure", "nobody", "flat", "turned", "far")
FRAMES = st.lists(
    st.tuples(st.sampled_from(KINDS), st.sampled_from([1, 1, 1, 2, 20]), st.integers(0, 9))
)


@contextmanager
def by_numpy():
    with pytest.MonkeyPatch.context() as patch:
        for module in (frames, guard, resample):
            patch.setattr(module, "KERNEL", None)
        yield


def make(kind: str, number: int, salt: int) -> tuple[np.ndarray | None, np.ndarray | None]:
    """A pose in the net's skeleton and its confidence."""
    pose, sure = PERSON[number % len(PERSON)].copy(), None
    if kind == "nobody":
        return None, None
    if kind == "hole":
        pose[salt::5] = np.nan
    elif kind in {"sure", "unsure"}:
        sure = np.full(len(pose), 0.9)
        sure[:salt] = 0.9 if kind == "sure" else 0.1
    elif kind == "flat":
        pose *= 0.0
    elif kind == "turned":
        pose *= [-1.0, -1.0, 1.0]
    elif kind == "far":
        pose[salt] = 101.0 if salt % 2 else np.inf
    return pose, sure


def push(buffer: FrameBuffer, t: float, pose: np.ndarray | None, sure: np.ndarray | None) -> object:
    try:
        restart = buffer.push(t, pose, sure)
    except BadFrameError as error:
        return str(error)
    return restart, buffer.look()


def check_equal(one: object, other: object) -> None:
    if not isinstance(one, tuple) or isinstance(one[1], Waiting):
        assert one == other
        return
    seen, expected = one[1], other[1]
    assert isinstance(seen, WindowReady)
    assert isinstance(expected, WindowReady)
    np.testing.assert_allclose(seen.window, expected.window, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(seen.last_joints, expected.last_joints)
    assert (seen.t, seen.flags, seen.filled) == (expected.t, expected.flags, expected.filled)


@settings(max_examples=50, deadline=None)
@given(FRAMES, st.sampled_from(["y", "z", "-y"]))
def test_windows_and_flags_are_the_same(given_frames: list[tuple[str, int, int]], up: str) -> None:
    there, here = (FrameBuffer(KINECT_V1, up=up) for _ in range(2))
    t = 0.0
    whole = [("whole", 1, 0)] * 16
    for number, (kind, steps, salt) in enumerate(whole + given_frames + whole):
        t += steps / 30
        pose, sure = make(kind, number, salt)
        with by_numpy():
            expected = push(there, t, pose, sure)
        check_equal(push(here, t, pose, sure), expected)


@pytest.mark.parametrize("name", sorted(SKELETONS))
def test_other_skeletons_are_measured_the_same(name: str) -> None:
    skeleton = SKELETONS[name]
    there, here = (FrameBuffer(skeleton) for _ in range(2))
    for number in range(40):
        pose = np.random.default_rng(number).normal(size=(len(skeleton.joints), 3))
        with by_numpy():
            expected = push(there, number / 30, pose, None)
        check_equal(push(here, number / 30, pose, None), expected)


@given(st.lists(st.floats(-3, 3), min_size=60, max_size=60), st.integers(0, 3))
def test_bodies_are_measured_the_same(numbers: list[float], row: int) -> None:
    pose, facts = np.reshape(numbers, (20, 3)), np.zeros((2, 4, 4))
    guard.note_body(pose, facts[0], row)
    with by_numpy():
        guard.note_body(pose, facts[1], row)
    np.testing.assert_allclose(facts[0], facts[1], rtol=1e-6, atol=1e-6)


@given(st.lists(st.tuples(*[st.floats(width=32)] * 3), max_size=4), st.floats(0, 1e6))
def test_coordinates_are_within_the_same_limit(
    rows: list[tuple[float, float, float]], limit: float
) -> None:
    pose = np.array(rows, np.float64).reshape(-1, 3)
    found = frames.is_within(pose, limit)
    with by_numpy():
        assert found == frames.is_within(pose, limit)


def test_sizes_that_do_not_fit_are_refused() -> None:
    pose, table, weights, facts = (
        np.zeros((20, 3)),
        np.zeros((12, 20)),
        np.zeros(6),
        np.zeros((3, 4)),
    )
    assert KERNEL is not None
    for wrong in (
        (pose[:-1], table, weights, 0.3, facts, 0),
        (pose, table[:-1], weights, 0.3, facts, 0),
        (pose, table, weights[:-1], 0.3, facts, 0),
        (pose, table, weights, 0.3, facts, 3),
        (pose, table, weights, 0.3, facts, -1),
    ):
        with pytest.raises(ValueError, match="do not fit"):
            KERNEL.measure_body(*wrong)
