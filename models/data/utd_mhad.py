"""Read the skeletons of UTD-MHAD as published: a folder of .mat files, or the zip that holds them.

UTD-MHAD (Chen, Jafari, Kehtarnavaz, ICIP 2015) was recorded with a Kinect v1 at 30 Hz: 27 actions,
8 subjects, 4 trials. Frames are in metres in the camera's right-handed frame: x to the facing
person's right, y up, z away from the camera.
"""

import io
import re
import struct
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Literal

import numpy as np
import scipy.io
from jaxtyping import Float32
from scipy.io.matlab import MatReadError

SOURCE = "utd-mhad"
RATE_HZ = 30.0
JOINTS = 20
MAX_MEMBER_BYTES = 4 * 1024 * 1024
"""Far above any recording of the data set (a clip takes some 60 kB), far below what would hurt."""
MAX_MEMBERS = 20_000
MAX_FRAMES = 9_000
MAX_METRES = 100.0
"""No sensor sees that far; values beyond are another unit or damage."""

_NAME = re.compile(r"a(?P<action>\d+)_s(?P<subject>\d+)_t(?P<trial>\d+)_skeleton\.mat")
# What scipy's reader raises for damaged, truncated or newer (HDF5) files, seen by feeding it some.
_MAT_ERRORS = (
    MatReadError,
    ValueError,
    TypeError,
    KeyError,
    IndexError,
    OSError,
    EOFError,
    OverflowError,
    MemoryError,
    NotImplementedError,
    UnboundLocalError,  # scipy's, for arrays of a kind that it does not know
    zlib.error,
    struct.error,
)


_NUMERIC_CLASSES = frozenset(
    ("double", "single", "int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64")
)
_MAT_HEADER_BYTES, _ARRAY, _COMPRESSED = 128, 14, 15
_NUMBERS = frozenset((*range(1, 8), 9, 12, 13))
"""Kinds of elements that are numbers; from MATLAB's description of its files of version 5."""


class RecordingError(ValueError):
    """A recording cannot be read; the message names the file and says what was expected."""


@dataclass(frozen=True, slots=True)
class MatName:
    """What a file name of UTD-MHAD says: `a{action}_s{subject}_t{trial}_skeleton.mat`."""

    action: str
    subject: str
    trial: str


def parse_name(name: str) -> MatName | None:
    """Read action, subject and trial from a file name; None for a file of another kind."""
    found = _NAME.fullmatch(PurePosixPath(name).name)
    return MatName(**found.groupdict()) if found else None


def read_mat(content: bytes | Path, *, name: str | None = None) -> Float32[np.ndarray, "time 20 3"]:
    """Read the poses of one .mat file: variable `d_skel`, [20 joints, 3, frames].

    Args:
        content: the file's bytes, or its path.
        name: what to call it in errors; the path where there is one.

    Returns:
        poses in metres, time first.

    Raises:
        RecordingError: if it is no such file, or its values are not finite.
    """
    name = name or (str(content) if isinstance(content, Path) else "<bytes>")
    try:
        raw = content if isinstance(content, bytes) else content.read_bytes()
        skeleton = _load_skeleton(raw)
    except _MAT_ERRORS as error:
        raise RecordingError(f"{name}: not a readable MATLAB file (version 5): {error}") from error
    return _check_poses(skeleton, name)


def _load_skeleton(raw: bytes) -> object:
    # The headers first: a small compressed file can hold an array that would fill the memory.
    found = {name: (shape, kind) for name, shape, kind in scipy.io.whosmat(io.BytesIO(raw))}  # type: ignore[arg-type]  # the stubs lack the file objects that scipy documents
    shape, kind = found.get("d_skel", ((), ""))
    if shape[:2] != (JOINTS, 3) or np.prod(shape) > JOINTS * 3 * MAX_FRAMES:
        return None
    if kind not in _NUMERIC_CLASSES:
        return None
    _refuse_unknown_numbers(raw)
    return scipy.io.loadmat(io.BytesIO(raw), variable_names=["d_skel"])["d_skel"]  # type: ignore[arg-type]  # as above


def _refuse_unknown_numbers(raw: bytes) -> None:
    """Refuse arrays of a kind of numbers that there is not: scipy would read beyond its table.

    Raises:
        ValueError: such an array, or a part that is longer than the file.
    """
    order: Literal["<", ">"] = "<" if raw[126:128] == b"IM" else ">"
    for array in _list_arrays(raw[_MAT_HEADER_BYTES:], order):
        unknown = {part for part, _ in _split_elements(array, order)} - _NUMBERS
        if unknown:
            raise ValueError(f"an array of unknown numbers: {sorted(unknown)}")


def _list_arrays(content: bytes, order: Literal["<", ">"]) -> Iterator[bytes]:
    """Yield the arrays of a file, unpacked."""
    for kind, part in _split_elements(content, order):
        if kind == _ARRAY:
            yield part
        elif kind == _COMPRESSED:
            unpacked = zlib.decompressobj().decompress(part, MAX_MEMBER_BYTES)
            yield from (own for inner, own in _split_elements(unpacked, order) if inner == _ARRAY)


def _split_elements(content: bytes, order: Literal["<", ">"]) -> Iterator[tuple[int, bytes]]:
    """Yield kind and content of the elements of a MATLAB file of version 5, one after another."""
    at = 0
    while at + 8 <= len(content):
        kind, size = struct.unpack_from(f"{order}II", content, at)
        if kind >> 16:  # a small one: its size and content share the eight bytes
            yield kind & 0xFFFF, content[at + 4 : at + 4 + (kind >> 16)]
            at += 8
            continue
        if at + 8 + size > len(content):
            raise ValueError("a part of it is longer than the file")
        yield kind, content[at + 8 : at + 8 + size]
        at += 8 + (size if kind == _COMPRESSED else -(-size // 8) * 8)


def _check_poses(skeleton: object, name: str) -> Float32[np.ndarray, "time 20 3"]:
    if (
        not isinstance(skeleton, np.ndarray)
        or skeleton.dtype.kind not in "fiu"
        or skeleton.ndim != 3
        or skeleton.shape[:2] != (JOINTS, 3)
        or not 1 <= skeleton.shape[2] <= MAX_FRAMES
    ):
        raise RecordingError(
            f"{name}: expected a variable d_skel with numbers of shape [20, 3, frames]"
        )
    if not (np.abs(skeleton) <= MAX_METRES).all():
        raise RecordingError(f"{name}: d_skel holds values beyond {MAX_METRES} m or not finite")
    return np.ascontiguousarray(skeleton.transpose(2, 0, 1), dtype=np.float32)


def find_mats(folder: Path) -> list[Path]:
    """Find every skeleton file below a folder, at any depth, in a fixed order."""
    return sorted(p for p in folder.rglob("*_skeleton.mat") if parse_name(p.name) and p.is_file())


def read_zip(path: Path) -> Iterator[tuple[str, bytes]]:
    """Yield name and bytes of every skeleton file in the published zip, without unpacking to disk.

    Raises:
        RecordingError: if it is no zip, holds no skeleton file, or one that is too large.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            members = [info for info in archive.infolist() if parse_name(info.filename)]
            if not members:
                raise RecordingError(f"{path}: expected a*_s*_t*_skeleton.mat files in the zip")
            if len(members) > MAX_MEMBERS:
                raise RecordingError(f"{path}: more than {MAX_MEMBERS} files")
            for info in sorted(members, key=lambda member: member.filename):
                yield info.filename, _read_member(archive, info, path)
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, OSError) as error:
        raise RecordingError(f"{path}: not a readable zip file: {error}") from error


def _read_member(archive: zipfile.ZipFile, info: zipfile.ZipInfo, path: Path) -> bytes:
    # The size in the directory may lie, so the cap is on what is really read.
    with archive.open(info) as member:
        content = member.read(MAX_MEMBER_BYTES + 1)
    if len(content) > MAX_MEMBER_BYTES:
        raise RecordingError(f"{path}: {info.filename} is larger than {MAX_MEMBER_BYTES} bytes")
    return content
