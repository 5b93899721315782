"""One array of numbers out of a MATLAB file of version 5.

Files come from strangers, and scipy's reader, which is compiled, ends the whole process at some
damaged ones (it looks up the kind of numbers beyond the end of a table). This reads what a
recording needs and nothing else: variables that are plain real numbers. Source: MathWorks, MAT-File
Format, of version 5.
"""

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from math import prod

import numpy as np

HEADER_BYTES = 128
_ORDERS = {b"IM": "<", b"MI": ">"}
_INT8, _INT32, _UINT32, _ARRAY, _COMPRESSED = 1, 5, 6, 14, 15
_KINDS = dict(
    zip(
        (1, 2, 3, 4, 5, 6, 7, 9, 12, 13),
        ["i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8", "i8", "u8"],
        strict=True,
    )
)
"""What numbers are stored as; MATLAB stores doubles as bytes where these hold them."""
_NUMERIC_CLASSES = range(6, 16)
_COMPLEX = 0x0800
_HEAD_BYTES = 4096
"""Of an array before its numbers, at most: flags, shape and name."""


@dataclass(frozen=True, slots=True)
class _Element:
    """A part of a file: the kind of its content, and the content."""

    kind: int
    content: bytes


def read_array(raw: bytes, name: str, *, most_bytes: int) -> np.ndarray | None:
    """Give a variable of a file.

    Args:
        raw: the file.
        name: of the variable.
        most_bytes: that it may take, unpacked; with more, and where it is no array of real numbers,
            it counts as absent.

    Returns:
        The array, its numbers as they are stored, or None where there is no such variable.

    Raises:
        ValueError: no file of version 5, or a damaged one.
    """
    order = _ORDERS.get(raw[126:HEADER_BYTES])
    if order is None:
        raise ValueError("it does not begin like one")
    try:
        for element in _split(raw[HEADER_BYTES:], order):
            head = _unpack(element, order, _HEAD_BYTES)
            if head is not None and _name_of(head, order) == name:
                array = _unpack(element, order, _HEAD_BYTES + most_bytes)
                return None if array is None else _read_numbers(array, order, most_bytes)
    except (zlib.error, struct.error) as error:
        raise ValueError(str(error)) from error
    return None


def _unpack(element: _Element, order: str, most_bytes: int) -> bytes | None:
    """Give the content of an array, or as much of a packed one; None for another kind."""
    if element.kind == _COMPRESSED:
        whole = zlib.decompressobj().decompress(element.content, most_bytes)
        if len(whole) < 8:
            raise ValueError("a packed part of it is empty")
        kind, size = struct.unpack_from(f"{order}II", whole)
        return whole[8 : 8 + size] if kind == _ARRAY else None
    return element.content if element.kind == _ARRAY else None


def _name_of(array: bytes, order: str) -> str:
    parts = _split(array, order)
    flags, shape, name = (next(parts, None) for _ in range(3))
    if flags is None or shape is None or name is None:
        raise ValueError("an array of it is cut off")
    if (flags.kind, shape.kind, name.kind) != (_UINT32, _INT32, _INT8) or len(flags.content) != 8:
        raise ValueError("an array of it does not begin like one")
    return name.content.decode("latin-1")


def _read_numbers(array: bytes, order: str, most_bytes: int) -> np.ndarray | None:
    """Read an array whose name was read before."""
    parts = _split(array, order)
    flags, shape, _ = (next(parts) for _ in range(3))
    (described,) = struct.unpack_from(f"{order}I", flags.content)
    if described & 0xFF not in _NUMERIC_CLASSES or described & _COMPLEX:
        return None
    sizes = np.frombuffer(shape.content, f"{order}i4").tolist()
    if min(sizes, default=-1) < 0 or prod(sizes) * 8 > most_bytes:
        return None
    numbers = next(parts, None)
    if numbers is None or numbers.kind not in _KINDS:
        raise ValueError(f"its numbers are of no known kind: {numbers and numbers.kind}")
    values = np.frombuffer(numbers.content, order + _KINDS[numbers.kind])
    if len(values) != prod(sizes):
        raise ValueError(f"{len(values)} numbers, where its shape says {prod(sizes)}")
    return values.reshape(sizes, order="F")


def _split(content: bytes, order: str) -> Iterator[_Element]:
    """Yield the elements one after another.

    Raises:
        ValueError: one that is longer than what is left.
    """
    at = 0
    while at + 8 <= len(content):
        kind, size = struct.unpack_from(f"{order}II", content, at)
        begin, step = at + 8, 8 + size
        if kind >> 16:  # a small one: its size and content share the eight bytes
            kind, size, begin, step = kind & 0xFFFF, kind >> 16, at + 4, 8
        elif kind != _COMPRESSED:
            step += -size % 8
        if begin + size > min(len(content), at + step):
            raise ValueError("a part of it is longer than the file")
        yield _Element(kind, content[begin : begin + size])
        at += step
