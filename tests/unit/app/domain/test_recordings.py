import zlib

import hypothesis.strategies as st
import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis.extra import numpy as arrays

from app.domain.recordings import DamagedChunkError, RawFrames, pack_frames, unpack_frames

joints = arrays.arrays(
    np.float32, (7, 5, 3), elements=st.floats(-100, 100, width=32) | st.just(np.nan)
)
times = arrays.arrays(np.float64, (7,), elements=st.floats(0, 2e9))


def make_frames(count, *, start=0.0, confidence=None):
    rng = np.random.default_rng(count)
    return RawFrames(
        t=start + np.arange(count) / 30.0,
        joints=rng.normal(size=(count, 5, 3)).astype(np.float32),
        confidence=confidence,
    )


@given(t=times, joints=joints, sure=st.booleans())
@settings(max_examples=50, deadline=None)
def test_frames_come_back_bit_for_bit(t, joints, sure):
    confidence = None if sure else np.abs(joints[..., 0])
    frames = RawFrames(t=t, joints=joints, confidence=confidence)
    read = unpack_frames([pack_frames(frames)])
    assert read.t.tobytes() == t.tobytes()
    assert read.joints.tobytes() == joints.tobytes()
    assert (read.confidence is None) == sure
    assert sure or read.confidence.tobytes() == confidence.tobytes()


def test_chunks_are_joined_in_their_order():
    first, second = make_frames(10), make_frames(3, start=1.0)
    read = unpack_frames([pack_frames(first), pack_frames(second)])
    assert len(read) == 13
    assert read.seconds == pytest.approx(1.0 + 2 / 30)


def test_chunk_without_confidences_counts_as_sure_among_others():
    unsure = np.full((3, 5), 0.5, dtype=np.float32)
    read = unpack_frames(
        [pack_frames(make_frames(2)), pack_frames(make_frames(3, confidence=unsure))]
    )
    assert read.confidence[:, 0].tolist() == [1, 1, 0.5, 0.5, 0.5]


@given(noise=st.binary(max_size=200))
@settings(max_examples=100, deadline=None)
def test_anything_else_is_damaged(noise):
    for content in (noise, zlib.compress(noise)):
        with pytest.raises(DamagedChunkError):
            unpack_frames([content])


@pytest.mark.parametrize(
    "fields",
    [
        [1, 2, 5, b"", b"", None],
        [2, 0, 5, b"", b"", None],
        [1, -1, 5, b"", b"", None],
        [1, 1, 5, b"\0" * 8, b"\0" * 60, b"\0" * 19],
    ],
)
def test_sizes_that_do_not_fit_are_damage(fields):
    with pytest.raises(DamagedChunkError):
        unpack_frames([zlib.compress(msgspec.msgpack.encode(fields))])


def test_clip_of_two_skeletons_or_of_nothing_is_damage():
    other = RawFrames(t=np.zeros(1), joints=np.zeros((1, 20, 3), dtype=np.float32))
    with pytest.raises(DamagedChunkError):
        unpack_frames([pack_frames(make_frames(1)), pack_frames(other)])
    with pytest.raises(DamagedChunkError):
        unpack_frames([])
