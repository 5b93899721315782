"""Clips: recorded motion of one person doing one thing, from every kind of file that we read."""

import hashlib
import struct
import zipfile
import zlib
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from models.data import utd_mhad
from models.data.utd_mhad import RecordingError

_NPZ_KEYS = ("frames", "lengths", "subject", "action", "trial", "rate_hz")


@dataclass(frozen=True, eq=False)
class Clip:
    """One continuous recording in the net's skeleton.

    Attributes:
        poses: [time, 20, 3] metres, y up, right-handed, in the frame of the sensor.
        subject: who, as a name within the source ("1").
        action: what, as a name within the source.
        trial: which repetition or session.
        source: the collection; subjects of two collections are never the same person.
        rate_hz: frames per second.
    """

    poses: Float32[np.ndarray, "time 20 3"]
    subject: str
    action: str
    trial: str
    source: str
    rate_hz: float = 30.0

    @property
    def person(self) -> tuple[str, str]:
        """Who it is among all collections: source and subject."""
        return self.source, self.subject


def load_clips(
    path: Path,
    *,
    subjects: Collection[str] | None = None,
    trials: Collection[str] | None = None,
) -> list[Clip]:
    """Read clips from a folder, a zip of UTD-MHAD, or an npz of the documented keys.

    A folder is searched at any depth for `a*_s*_t*_skeleton.mat` and for `*.npz`; where it has
    neither, for the published `Skeleton.zip`. An npz holds `frames` [N, 20, 3] (all sequences one
    after another), `lengths`, `subject`, `action`, `trial` [S] and `rate_hz`; its file name without
    the suffix is the source.

    Args:
        path: the folder or file.
        subjects: keep only these; None keeps everybody.
        trials: keep only these; None keeps all.

    Returns:
        clips ordered by source, subject, action, trial and place in the file. Empty only where the
        filters leave nothing.

    Raises:
        RecordingError: naming the file and what was expected of it.
    """
    for name, chosen in (("subjects", subjects), ("trials", trials)):
        if isinstance(chosen, str):
            raise TypeError(f"{name} must be a collection of strings, not one string: {chosen!r}")
    found = _read_clips(path, subjects=subjects, trials=trials)
    return sorted(found, key=_order)


def data_hash(clips: Iterable[Clip]) -> str:
    """Hex SHA-256 over the contents of the clips, in their order: what a model was trained on."""
    digest = hashlib.sha256()
    for clip in clips:
        header = "\x1f".join((clip.source, clip.subject, clip.action, clip.trial))
        digest.update(header.encode())
        digest.update(struct.pack("<dq", clip.rate_hz, len(clip.poses)))
        digest.update(np.ascontiguousarray(clip.poses, dtype="<f4").tobytes())
    return digest.hexdigest()


@dataclass(frozen=True, slots=True, kw_only=True)
class _Filter:
    subjects: Collection[str] | None
    trials: Collection[str] | None

    def keeps(self, subject: str, trial: str) -> bool:
        return (self.subjects is None or subject in self.subjects) and (
            self.trials is None or trial in self.trials
        )


def _read_clips(
    path: Path, *, subjects: Collection[str] | None, trials: Collection[str] | None
) -> Iterator[Clip]:
    wanted = _Filter(subjects=subjects, trials=trials)
    if path.is_dir():
        yield from _read_folder(path, wanted)
    elif not path.is_file():
        raise RecordingError(f"{path}: no such file or folder")
    elif path.suffix == ".zip":
        yield from _read_zip(path, wanted)
    elif path.suffix == ".npz":
        yield from _read_npz(path, wanted)
    elif path.suffix == ".mat":
        yield from _read_mats([path], wanted)
    else:
        raise RecordingError(f"{path}: expected a folder, .zip, .npz or .mat")


def _read_folder(folder: Path, wanted: _Filter) -> Iterator[Clip]:
    mats, npzs = utd_mhad.find_mats(folder), sorted(folder.rglob("*.npz"))
    zips = [] if mats or npzs else sorted(folder.rglob("Skeleton.zip"))
    if not (mats or npzs or zips):
        raise RecordingError(
            f"{folder}: expected a*_s*_t*_skeleton.mat files, an .npz or Skeleton.zip in it"
        )
    yield from _read_mats(mats, wanted)
    for npz in npzs:
        yield from _read_npz(npz, wanted)
    for archive in zips:
        yield from _read_zip(archive, wanted)


def _read_mats(paths: Iterable[Path], wanted: _Filter) -> Iterator[Clip]:
    for path in paths:
        yield from _read_utd(path.name, path, str(path), wanted)


def _read_zip(path: Path, wanted: _Filter) -> Iterator[Clip]:
    for member, content in utd_mhad.read_zip(path):
        yield from _read_utd(member, content, f"{path}: {member}", wanted)


def _read_utd(name: str, content: bytes | Path, label: str, wanted: _Filter) -> Iterator[Clip]:
    about = utd_mhad.parse_name(name)
    if about is None:
        raise RecordingError(f"{label}: expected a name like a1_s1_t1_skeleton.mat")
    if wanted.keeps(about.subject, about.trial):
        yield Clip(
            poses=utd_mhad.read_mat(content, name=label),
            subject=about.subject,
            action=about.action,
            trial=about.trial,
            source=utd_mhad.SOURCE,
            rate_hz=utd_mhad.RATE_HZ,
        )


def _read_npz(path: Path, wanted: _Filter) -> Iterator[Clip]:
    arrays = _open_npz(path)
    frames, lengths = arrays["frames"], arrays["lengths"]
    names = zip(arrays["subject"], arrays["action"], arrays["trial"], strict=True)
    stops = np.cumsum(lengths)
    for (subject, action, trial), stop, length in zip(names, stops, lengths, strict=True):
        if wanted.keeps(str(subject), str(trial)):
            yield Clip(
                poses=np.ascontiguousarray(frames[stop - length : stop], dtype=np.float32),
                subject=str(subject),
                action=str(action),
                trial=str(trial),
                source=path.stem,
                rate_hz=float(arrays["rate_hz"]),
            )


def _open_npz(path: Path) -> dict[str, np.ndarray]:
    try:
        # Opened here, because numpy leaves a file open that turns out not to be a zip.
        with path.open("rb") as handle, np.load(handle, allow_pickle=False) as file:
            arrays = {key: file[key] for key in _NPZ_KEYS if key in file}
    except (
        ValueError,
        OSError,
        EOFError,
        KeyError,
        TypeError,
        zipfile.BadZipFile,
        zlib.error,
    ) as error:
        raise RecordingError(f"{path}: not a readable npz without pickles: {error}") from error
    problem = _find_npz_problem(arrays)
    if problem:
        raise RecordingError(f"{path}: {problem}")
    return arrays


def _find_npz_problem(arrays: dict[str, np.ndarray]) -> str | None:
    if len(arrays) < len(_NPZ_KEYS):
        return f"missing {sorted(set(_NPZ_KEYS) - set(arrays))}; expected {list(_NPZ_KEYS)}"
    frames, lengths = arrays["frames"], arrays["lengths"]
    if frames.ndim != 3 or frames.shape[1:] != (20, 3) or frames.dtype.kind != "f":
        return f"expected frames as floats of shape [N, 20, 3], got {frames.dtype} {frames.shape}"
    if lengths.ndim != 1 or lengths.dtype.kind not in "iu" or (lengths < 1).any():
        return "expected lengths as positive integers [S]"
    if int(lengths.sum(dtype=np.int64)) != len(frames):
        return f"lengths add up to {lengths.sum()}, but there are {len(frames)} frames"
    if not (np.abs(frames) <= utd_mhad.MAX_METRES).all():
        return f"frames hold values beyond {utd_mhad.MAX_METRES} m or not finite"
    return _find_label_problem(arrays)


def _find_label_problem(arrays: dict[str, np.ndarray]) -> str | None:
    for key in ("subject", "action", "trial"):
        if arrays[key].shape != arrays["lengths"].shape or arrays[key].dtype.kind != "U":
            return f"expected {key} as strings, one per sequence"
    if arrays["rate_hz"].size != 1 or not 0 < float(arrays["rate_hz"]) < 1000:
        return "expected rate_hz as one positive number"
    return None


def _order(clip: Clip) -> tuple[str, tuple[int, str], tuple[int, str], tuple[int, str]]:
    # Numbers by value, so that subject 10 comes after 9; the sort is stable within a file.
    return (
        clip.source,
        _natural(clip.subject),
        _natural(clip.action),
        _natural(clip.trial),
    )


def _natural(name: str) -> tuple[int, str]:
    return (int(name), name) if name.isdecimal() else (-1, name)
