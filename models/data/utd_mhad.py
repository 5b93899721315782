"""Read the skeletons of UTD-MHAD as published: a folder of .mat files, or the zip that holds them.

UTD-MHAD (Chen, Jafari, Kehtarnavaz, ICIP 2015) was recorded with a Kinect v1 at 30 Hz: 27 actions,
8 subjects, 4 trials. Frames are in metres in the camera's right-handed frame: x to the facing
person's right, y up, z away from the camera.
"""

import re
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Float32

from models.data.matlab import read_array

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
        skeleton = read_array(raw, "d_skel", most_bytes=JOINTS * 3 * MAX_FRAMES * 8)
    except (ValueError, OSError) as error:
        raise RecordingError(f"{name}: not a readable MATLAB file (version 5): {error}") from error
    return _check_poses(skeleton, name)


def _check_poses(skeleton: np.ndarray | None, name: str) -> Float32[np.ndarray, "time 20 3"]:
    if (
        skeleton is None
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
