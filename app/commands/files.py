"""Files that commands of researchers read and write: recordings in, figures and weights out."""

import os
from pathlib import Path

from app.commands.output import err, fail
from models.data.clips import Clip, load_clips
from models.data.splits import without_examination
from models.data.utd_mhad import RecordingError
from models.spec import MotionSpec


def read_clips(path: Path, subjects: str | None) -> list[Clip]:
    """Read recordings of all subjects or of some, such as 1,3,5; on failure say so and exit."""
    try:
        clips = load_clips(path, subjects=subjects.split(",") if subjects else None)
    except (OSError, RecordingError) as error:
        fail(str(error), status=2)
    rate_hz = MotionSpec().rate_hz
    for clip in clips:
        if clip.rate_hz != rate_hz:
            told = (
                f"{path}: {clip.source} has {clip.rate_hz:g} Hz; bring it to {rate_hz:g} Hz first"
            )
            fail(told, status=2)
    return clips


def read_more_people(path: Path | None) -> list[Clip]:
    """Read what is mixed into training, without the people who only test; say who is left out."""
    if path is None:
        return []
    clips = read_clips(path, None)
    kept = without_examination(clips)
    dropped = sorted({clip.person for clip in clips} - {clip.person for clip in kept})
    if dropped:
        names = ", ".join("/".join(person) for person in dropped)
        err.print(f"Not trained on, as they only test: {names}")
    return kept


def refuse_place(option: str, path: Path) -> None:
    """Refuse what no file can be written to, before hours of computing rather than after."""
    if path.is_dir():
        fail(f"{option}: {path} is a folder, not a file", status=2)
    nearest = next(folder for folder in path.absolute().parents if folder.exists())
    if not nearest.is_dir():
        fail(f"{option}: {nearest} is no folder", status=2)
    if not os.access(nearest, os.W_OK | os.X_OK):
        fail(f"{option}: nothing may be written in {nearest}", status=2)
