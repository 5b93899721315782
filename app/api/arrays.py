"""Poses, times and confidences on the wire, to numpy and back.

In JSON they are nested lists, where `null` stands for a missing joint or a frame without the
person. In msgpack they may also be `{"shape", "dtype", "data"}` with little-endian floats, where
NaN stands for a missing coordinate.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Float64
from pydantic_core import PydanticCustomError

WIRE_TYPES: dict[str, np.dtype[Any]] = {"<f4": np.dtype("<f4"), "<f8": np.dtype("<f8")}
_COORDINATES = 3
_NUMBERS = frozenset({int, float})
_NO_JOINT = [math.nan] * _COORDINATES

Location = tuple[int, ...]


class _Wrong(NamedTuple):
    loc: Location
    msg: str


_NO_POSE = _Wrong((), "there must be a frame with joints")


def parse_poses(value: object) -> Float[np.ndarray, "time joint 3"]:
    """Read `frames`: NaN where a joint, or a whole frame, is missing.

    Raises:
        PydanticCustomError: naming the first place that is wrong.
    """
    if isinstance(value, dict):
        poses = _parse_buffer(value, ndim=3, wire_types=("<f4", "<f8"))
        if poses.size == 0:
            raise _refuse(_NO_POSE)
        return poses
    frames = _expect_list(value, ())
    joints = next((len(frame) for frame in frames if isinstance(frame, list)), 0)
    if joints == 0:
        raise _refuse(_NO_POSE)
    flat: list[Any] = []
    absent = _NO_JOINT * joints
    for frame in frames:
        if frame is None:
            flat.extend(absent)
            continue
        for joint in _expect_joints(frame, frames, joints):
            flat.extend(_NO_JOINT if joint is None else _expect_triple(joint, frames))
    numbers = _to_floats(flat, lambda: _find_number(frames))
    return numbers.reshape(len(frames), joints, _COORDINATES)


def parse_times(value: object) -> Float[np.ndarray, " time"]:
    """Read `t`, seconds in float64: float32 cannot tell frames apart after a few hours.

    Raises:
        PydanticCustomError: naming the first place that is wrong.
    """
    if isinstance(value, dict):
        return _parse_buffer(value, ndim=1, wire_types=("<f8",))
    times = _expect_list(value, ())
    return _to_floats(times, lambda: _find_in_row(times, ()))


def parse_confidence(value: object) -> Float[np.ndarray, "time joint"]:
    """Read `confidence`, one number for each joint of each frame.

    Raises:
        PydanticCustomError: naming the first place that is wrong.
    """
    if isinstance(value, dict):
        return _parse_buffer(value, ndim=2, wire_types=("<f4", "<f8"))
    rows = _expect_list(value, ())
    joints = len(rows[0]) if rows and isinstance(rows[0], list) else 0
    flat: list[Any] = []
    for i, row in enumerate(rows):
        if len(_expect_list(row, (i,))) != joints:
            raise _refuse(_Wrong((i,), f"expected {joints} confidences, as in the first frame"))
        flat.extend(row)
    wrong = (found for i, row in enumerate(rows) for found in _find_in_row(row, (i,)))
    return _to_floats(flat, lambda: wrong).reshape(len(rows), joints)


def to_wire(array: Float[np.ndarray, "..."], wire_type: str) -> dict[str, Any]:
    """Write an array for msgpack."""
    data = np.ascontiguousarray(array, dtype=WIRE_TYPES[wire_type]).tobytes()
    return {"shape": list(array.shape), "dtype": wire_type, "data": data}


def to_lists(array: Float[np.ndarray, "..."]) -> list[Any]:
    """Write an array for JSON, to the micrometre or microsecond: that is far below any sensor."""
    lists: list[Any] = np.round(array.astype(np.float64), 6).tolist()
    return lists


def _parse_buffer(
    value: dict[Any, Any], *, ndim: int, wire_types: Sequence[str]
) -> Float64[np.ndarray, "..."]:
    """Read `{"shape", "dtype", "data"}`."""
    unknown = sorted(str(key) for key in value.keys() - {"shape", "dtype", "data"})
    if unknown or len(value) != 3:
        raise _refuse(_Wrong((), "an array is {shape, dtype, data}"))
    shape, wire_type, data = value["shape"], value["dtype"], value["data"]
    if wire_type not in wire_types:
        raise _refuse(_Wrong((), f"dtype must be {' or '.join(wire_types)}"))
    whole = isinstance(shape, list) and all(type(n) is int and n >= 0 for n in shape)
    if not whole or len(shape) != ndim or (ndim == 3 and shape[2] != _COORDINATES):
        raise _refuse(_Wrong((), f"shape must be {ndim} whole numbers, the last one 3 for poses"))
    item = WIRE_TYPES[wire_type]
    if not isinstance(data, bytes) or len(data) != math.prod(shape) * item.itemsize:
        raise _refuse(_Wrong((), "data must be as many bytes as shape and dtype say"))
    return np.frombuffer(data, dtype=item).reshape(shape).astype(np.float64)


def _expect_list(value: object, loc: Location) -> list[Any]:
    if not isinstance(value, list):
        raise _refuse(_Wrong(loc, f"expected a list, got {_name(value)}"))
    return value


def _expect_joints(frame: object, frames: list[Any], joints: int) -> list[Any]:
    if isinstance(frame, list) and len(frame) == joints:
        return frame
    i = next(i for i, other in enumerate(frames) if other is frame)
    _expect_list(frame, (i,))
    raise _refuse(_Wrong((i,), f"expected {joints} joints, as in the other frames"))


def _expect_triple(joint: object, frames: list[Any]) -> list[Any]:
    if isinstance(joint, list) and len(joint) == _COORDINATES:
        return joint
    raise _refuse(
        next(
            _Wrong((i, j), "expected [x, y, z], or null for a missing joint")
            for i, frame in enumerate(frames)
            for j, other in enumerate(frame or ())
            if other is joint
        )
    )


def _to_floats(
    flat: list[Any], find: Callable[[], Iterator[_Wrong]]
) -> Float[np.ndarray, " number"]:
    """Turn numbers into float64; look for the wrong one only where there is one."""
    if _NUMBERS.issuperset(map(type, flat)):
        try:
            return np.array(flat, dtype=np.float64)
        except OverflowError:
            pass
    raise _refuse(next(find()))


def _find_number(frames: list[Any]) -> Iterator[_Wrong]:
    for i, frame in enumerate(frames):
        for j, joint in enumerate(frame or ()):
            yield from _find_in_row(joint or (), (i, j))


def _find_in_row(row: Sequence[Any], loc: Location) -> Iterator[_Wrong]:
    for k, number in enumerate(row):
        if type(number) not in _NUMBERS:
            yield _Wrong((*loc, k), f"expected a number, got {_name(number)}")
        elif abs(number) > 1e300:
            yield _Wrong((*loc, k), "the number is too large")


def _name(value: object) -> str:
    names = {str: "a text", bool: "true or false", dict: "an object", list: "a list"}
    return "null" if value is None else names.get(type(value), "something else")


def _refuse(wrong: _Wrong) -> PydanticCustomError:
    place = "".join(f"[{index}]" for index in wrong.loc)
    return PydanticCustomError(
        "bad_array",
        "{place}: {msg}",
        {"place": place or "array", "msg": wrong.msg, "at": wrong.loc},
    )
