"""Recordings in files: UTD-MHAD's `.mat`, `.npz` without pickles, and `.csv`.

Run only in a child process with limits: what a file of unknown origin does to a parser must not
happen where forecasts are made.
"""

import codecs
import csv
import io
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Float

from app.domain.errors import BadRecordingError
from models.data import utd_mhad
from models.data.clips import Clip, load_clips
from models.data.utd_mhad import RecordingError
from models.skeleton import SKELETONS

SUFFIXES = (".mat", ".npz", ".csv")
CSV_COLUMNS = "t (optional), clip and action (optional), NAME.x, NAME.y, NAME.z for every joint"
NAME_MAX = 200
"""Characters of a file's name that name an action; what a file calls one itself is never cut."""
_AXES = ("x", "y", "z")


@dataclass(frozen=True, eq=False)
class FileClip:
    """One clip of a file: poses as they are in it, NaN where a joint is missing.

    Attributes:
        joints: metres.
        t: seconds, None for 30 Hz.
        action: what the file calls it.
    """

    joints: Float[np.ndarray, "time joint 3"]
    t: Float[np.ndarray, " time"] | None
    action: str | None


def read_file(name: str, content: bytes, *, skeleton: str) -> list[FileClip]:
    """Read the clips of one file.

    Args:
        name: of the file; its suffix decides.
        content: its bytes.
        skeleton: format of the user, whose joint names a `.csv` has.

    Raises:
        BadRecordingError: it cannot be read, or holds several people.
    """
    suffix = PurePosixPath(name).suffix.lower()
    if suffix == ".csv":
        return list(_read_csv(name, content, skeleton))
    if suffix not in SUFFIXES:
        raise BadRecordingError(f"{name}: expected one of {', '.join(SUFFIXES)}.")
    try:
        clips = _read_mat(name, content) if suffix == ".mat" else _read_npz(content)
    except RecordingError as error:
        raise BadRecordingError(_without_path(str(error), name)) from None
    except MemoryError:
        raise BadRecordingError(f"{name}: it needs more memory than is allowed.") from None
    if not clips:
        raise BadRecordingError(f"{name}: it has no clips.")
    people = sorted({clip.subject for clip in clips})
    if len(people) > 1:
        raise BadRecordingError(f"{name}: it holds several people ({', '.join(people)}).")
    return [_to_file_clip(clip) for clip in clips]


def _read_mat(name: str, content: bytes) -> list[Clip]:
    about = utd_mhad.parse_name(name)
    return [
        Clip(
            poses=utd_mhad.read_mat(content, name=name),
            subject=about.subject if about else "",
            action=about.action if about else PurePosixPath(name).stem[:NAME_MAX],
            trial=about.trial if about else "",
            source=utd_mhad.SOURCE,
        )
    ]


def _read_npz(content: bytes) -> list[Clip]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "upload.npz"
        path.write_bytes(content)
        return load_clips(path)


def _to_file_clip(clip: Clip) -> FileClip:
    t = None if clip.rate_hz == utd_mhad.RATE_HZ else np.arange(len(clip.poses)) / clip.rate_hz
    return FileClip(clip.poses.astype(np.float64), t, clip.action or None)


def _without_path(message: str, name: str) -> str:
    """Say what is wrong without the path of a temporary file."""
    _, _, rest = message.partition("upload.npz")
    return f"{name}{rest}" if rest else message


def _read_csv(name: str, content: bytes, skeleton: str) -> Iterator[FileClip]:
    if not content.removeprefix(codecs.BOM_UTF8).strip():
        raise BadRecordingError(f"{name}: it is empty.")
    try:
        reader = csv.DictReader(io.StringIO(content.decode("utf-8-sig")), strict=True)
        rows, header = list(reader), reader.fieldnames or ()
    except (UnicodeDecodeError, csv.Error) as error:
        raise BadRecordingError(f"{name}: no CSV in UTF-8: {error}.") from None
    joints = SKELETONS[skeleton].joints
    columns = [f"{joint}.{axis}" for joint in joints for axis in _AXES]
    missing = [column for column in columns if column not in header]
    if missing:
        raise BadRecordingError(
            f"{name}: without a column {missing[0]}; a row is a frame, with {CSV_COLUMNS} of "
            f"{skeleton}."
        )
    if not rows:
        raise BadRecordingError(f"{name}: it has no frames, only the names of columns.")
    for group in _group(rows):
        numbers = [[_read_number(row[column], name) for column in columns] for row in group]
        poses = np.array(numbers).reshape(len(group), len(joints), 3)
        t = np.array([_read_number(row["t"], name) for row in group]) if "t" in group[0] else None
        yield FileClip(poses, t, group[0].get("action") or None)


def _group(rows: list[dict[str, str]]) -> Iterator[list[dict[str, str]]]:
    """Cut the rows wherever `clip` or `action` changes."""
    group: list[dict[str, str]] = []
    for row in rows:
        if group and any(row.get(key) != group[-1].get(key) for key in ("clip", "action")):
            yield group
            group = []
        group.append(row)
    yield group


def _read_number(text: str | None, name: str) -> float:
    """Read a cell; an empty one is a missing joint."""
    if text is None or not text.strip():
        return float("nan")
    try:
        return float(text)
    except ValueError:
        raise BadRecordingError(f"{name}: {text[:40]!r} is no number.") from None
