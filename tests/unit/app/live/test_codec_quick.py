"""A frame that is read in one go is what it would be piece by piece, and so are its errors."""

import json
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from app.live.codec import Codec
from app.live.protocol import JSON, MSGPACK, Observation, Rejected

JOINTS = 2
TEXT, BINARY = Codec(JSON, joints=JOINTS), Codec(MSGPACK, joints=JOINTS)
NUMBERS = st.floats(width=32) | st.integers(-3, 3)
COUNTS = st.sampled_from([0, 1, 2, 2, 2, 3])
FLOATS = COUNTS.flatmap(lambda n: st.lists(NUMBERS, min_size=n, max_size=n))
BLOBS = st.builds(
    lambda n, fill: bytes([fill]) * n, st.sampled_from([0, 4, 8, 12, 23, 24]), st.integers(0, 255)
)
ROWS = COUNTS.flatmap(
    lambda n: st.lists(FLOATS | st.tuples(*[NUMBERS] * 3) | st.none(), min_size=n, max_size=n)
)
ODD = st.none() | st.text(max_size=3) | st.booleans() | st.just({})
FIELDS = st.fixed_dictionaries(
    {
        "type": st.sampled_from(["frame"] * 6 + ["reset", "ping", "x"]),
        "seq": st.integers(-1, 2**53) | st.just(7) | ODD,
        "t": NUMBERS | ODD,
    },
    optional={
        "joints": ROWS | BLOBS | ODD,
        "confidence": FLOATS | BLOBS | ODD,
        "replay": st.booleans() | ODD,
        "more": ODD,
    },
)
CHANGES = st.lists(st.tuples(st.integers(0, 10_000), st.integers(-1, 255)), max_size=3)


def damage(data: bytes, changes: list[tuple[int, int]]) -> bytes:
    """Put other bytes in some places, or take them out."""
    for place, value in changes:
        at = place % max(len(data), 1)
        data = data[:at] + (bytes([value]) if value >= 0 else b"") + data[at + 1 :]
    return data


def describe(message: Any) -> object:
    if isinstance(message, Rejected):
        return type(message.error), message.error.message, message.seq
    if not isinstance(message, Observation):
        return message
    arrays = (message.joints, message.confidence)
    given_arrays = [
        None if one is None else (one.shape, one.dtype, one.tobytes()) for one in arrays
    ]
    return message.seq, message.t, message.replay, given_arrays


def check(codec: Codec, data: bytes) -> None:
    assert describe(codec.decode(data if codec.is_binary else data.decode())) == describe(
        codec._decode_other(data)
    )


@given(FIELDS, CHANGES)
def test_in_msgpack(fields: dict[str, Any], changes: list[tuple[int, int]]) -> None:
    check(BINARY, damage(msgspec.msgpack.encode(fields), changes))


@given(FIELDS, CHANGES)
@example({"type": "frame", "seq": 1, "t": float("nan"), "joints": []}, [])
@example({"type": "frame", "seq": 1, "t": 1e400, "joints": "x"}, [])
def test_in_json(fields: dict[str, Any], changes: list[tuple[int, int]]) -> None:
    whole = json.dumps(fields, default=lambda blob: blob.decode("latin-1")).encode()
    damaged = damage(whole, changes).decode(errors="replace").encode()
    check(TEXT, damaged)


@pytest.mark.parametrize("codec", [TEXT, BINARY])
def test_the_last_of_two_equal_keys_counts_even_where_the_first_is_wrong(codec: Codec) -> None:
    right = [[0.0] * 3] * JOINTS if codec is TEXT else bytes(12 * JOINTS)
    if codec is TEXT:
        data = b'{"type":"frame","seq":1,"t":2,"joints":7,"joints":%s}' % json.dumps(right).encode()
    else:
        pairs = (("type", "frame"), ("seq", 1), ("t", 2), ("joints", 7), ("joints", right))
        words = (msgspec.msgpack.encode(word) for pair in pairs for word in pair)
        data = b"\x85" + b"".join(words)
    check(codec, data)
    message = codec.decode(data if codec.is_binary else data.decode())
    assert isinstance(message, Observation)
    np.testing.assert_array_equal(message.joints, np.zeros((JOINTS, 3)))
