"""What is cut out of a stream of bytes is what the library would have read."""

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st
from websockets.frames import Frame, Opcode

from app.api.framing import Pieces, wrap

MOST = 1000
MESSAGES = st.lists(
    st.tuples(
        st.sampled_from([Opcode.BINARY, Opcode.BINARY, Opcode.TEXT, Opcode.PING, Opcode.PONG]),
        st.text(max_size=100).map(str.encode) | st.integers(0, 1200).map(bytes),
    ),
    max_size=8,
)


def serialize(kind: Opcode, data: bytes, *, fin: bool = True) -> bytes:
    payload = data[:125] if kind in {Opcode.PING, Opcode.PONG} else data
    return Frame(kind, payload, fin=fin).serialize(mask=True)


def cut(stream: bytes, places: list[int]) -> list[bytes]:
    ends = [0, *sorted(place % (len(stream) + 1) for place in places), len(stream)]
    return [stream[a:b] for a, b in pairwise(ends) if a < b]


@given(MESSAGES, st.lists(st.integers(0, 5000), max_size=6))
def test_nothing_is_lost_or_changed_however_the_bytes_come(
    messages: list[tuple[Opcode, bytes]], places: list[int]
) -> None:
    stream = b"".join(serialize(*message) for message in messages)
    pieces = Pieces(MOST)
    given_on, taken = b"", []
    for part in cut(stream, places):
        for message, piece in pieces.split(part):
            given_on += piece
            if message is not None:
                taken.append(message)
    assert given_on == stream
    expected: list[str | bytes] = []
    for kind, data in messages:
        if kind in {Opcode.TEXT, Opcode.BINARY}:
            if len(data) > MOST:
                break
            expected.append(data.decode() if kind is Opcode.TEXT else data)
    assert taken == expected


@pytest.mark.parametrize(
    "odd",
    [
        serialize(Opcode.BINARY, b"half", fin=False),
        Frame(Opcode.BINARY, b"naked").serialize(mask=False),
        serialize(Opcode.CLOSE, b"\x03\xe8"),
        serialize(Opcode.BINARY, bytes(70_000)),
        b"\xf2\x80abcd",
    ],
    ids=["part", "unmasked", "close", "long", "extension"],
)
def test_what_is_odd_is_left_to_the_library_and_so_is_all_that_follows(odd: bytes) -> None:
    pieces = Pieces(MOST)
    after = serialize(Opcode.BINARY, b"after")
    found = list(pieces.split(serialize(Opcode.BINARY, b"before") + odd + after))
    assert [message for message, _ in found] == [b"before", None]
    assert found[1][1] == odd + after
    assert list(pieces.split(after)) == [(None, after)]


def test_text_that_is_none_is_left_to_the_library() -> None:
    stream = serialize(Opcode.TEXT, b"\xff")
    assert list(Pieces(MOST).split(stream)) == [(None, stream)]


def test_a_message_that_is_announced_too_long_is_told_before_it_is_there() -> None:
    stream = serialize(Opcode.BINARY, bytes(MOST + 1))
    assert list(Pieces(MOST).split(stream[:8])) == [(None, stream[:8])]


@given(st.binary(max_size=300) | st.sampled_from([125, 126, 65_535, 65_536]).map(bytes))
def test_frames_are_those_of_the_library(data: bytes) -> None:
    theirs = Frame(Opcode.BINARY, data).serialize(mask=False)
    assert wrap(Opcode.BINARY, data) == theirs
