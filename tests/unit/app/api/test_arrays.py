import math
from contextlib import suppress

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic_core import PydanticCustomError

from app.api.arrays import parse_confidence, parse_poses, parse_times, to_lists, to_wire

JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=3) | st.binary(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner),
    max_leaves=12,
)


def refused_at(parse, value):
    with pytest.raises(PydanticCustomError) as caught:
        parse(value)
    return caught.value.context["at"]


def test_missing_joints_and_frames_become_nan():
    poses = parse_poses([[[1, 2.5, 3], None], None])
    assert poses.shape == (2, 2, 3)
    assert poses[0, 0].tolist() == [1.0, 2.5, 3.0]
    assert np.isnan(poses[0, 1]).all()
    assert np.isnan(poses[1]).all()


@pytest.mark.parametrize(
    ("frames", "at"),
    [
        ("text", ()),
        ([], ()),
        ([None], ()),
        ([[]], ()),
        ([[[1, 2, 3]], 7], (1,)),
        ([[[1, 2, 3]], [[1, 2, 3], [1, 2, 3]]], (1,)),
        ([[[1, 2, 3]], [[1, 2]]], (1, 0)),
        ([[[1, 2, 3]], [5]], (1, 0)),
        ([[[1, 2, 3], None], [None, [1, "2", 3]]], (1, 1, 1)),
        ([[[1, 2, True]]], (0, 0, 2)),
        ([[[1, 2, None]]], (0, 0, 2)),
        ([[[1, 2, 10**400]]], (0, 0, 2)),
    ],
)
def test_wrong_poses_are_refused_with_their_place(frames, at):
    assert refused_at(parse_poses, frames) == at


@pytest.mark.parametrize(("times", "at"), [(3, ()), ([0, "1"], (1,)), ([0, None], (1,))])
def test_wrong_times_are_refused_with_their_place(times, at):
    assert refused_at(parse_times, times) == at


@pytest.mark.parametrize(
    ("rows", "at"), [({}, ()), ([1], ()), ([[1], [1, 1]], (1,)), ([[1], [None]], (1, 0))]
)
def test_wrong_confidence_is_refused_with_its_place(rows, at):
    assert refused_at(parse_confidence, rows)[: len(at)] == at


@pytest.mark.parametrize("wire_type", ["<f4", "<f8"])
def test_arrays_survive_the_binary_wire(wire_type):
    poses = np.random.default_rng(0).normal(size=(4, 5, 3)).astype(wire_type)
    poses[1, 2] = math.nan
    sent = msgspec.msgpack.decode(msgspec.msgpack.encode(to_wire(poses, wire_type)))
    np.testing.assert_array_equal(parse_poses(sent), poses.astype(np.float64))


@pytest.mark.parametrize(
    "change",
    [
        {"dtype": "<f2"},
        {"dtype": ["<f4"]},
        {"shape": [2, 1]},
        {"shape": [2, 1, 2]},
        {"shape": [2, 1, 3.0]},
        {"shape": [-2, -1, 3]},
        {"shape": "213"},
        {"data": b"123"},
        {"data": "text"},
        {"more": 1},
    ],
)
def test_binary_arrays_that_contradict_themselves_are_refused(change):
    sent = to_wire(np.zeros((2, 1, 3)), "<f4") | change
    assert refused_at(parse_poses, sent) == ()


@pytest.mark.parametrize("shape", [(0, 20, 3), (2, 0, 3)])
def test_no_frames_are_refused_as_in_lists(shape):
    with pytest.raises(PydanticCustomError, match="there must be a frame with joints"):
        parse_poses(to_wire(np.zeros(shape), "<f4"))


def test_times_are_never_float32():
    assert parse_times(to_wire(np.array([1.7e9]), "<f8")).tolist() == [1.7e9]
    refused_at(parse_times, to_wire(np.array([1.7e9]), "<f4"))


def test_lists_keep_micrometres():
    assert to_lists(np.array([0.1234564, -2.0], dtype=np.float64)) == [0.123456, -2.0]


@given(JSON)
@settings(deadline=None, max_examples=200)
def test_anything_is_an_array_or_refused(value):
    for parse in (parse_poses, parse_times, parse_confidence):
        with suppress(PydanticCustomError):
            assert parse(value).dtype == np.float64
