import io
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.io

from models.data.clips import Clip, data_hash, load_clips
from models.data.utd_mhad import RecordingError

RANDOM = np.random.default_rng(0)


def write_mat(folder: Path, name: str, frames: int = 40) -> bytes:
    buffer = io.BytesIO()
    scipy.io.savemat(buffer, {"d_skel": RANDOM.normal(size=(20, 3, frames))})
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_bytes(buffer.getvalue())
    return buffer.getvalue()


def npz_arrays() -> dict[str, np.ndarray]:
    return {
        "frames": RANDOM.normal(size=(90, 20, 3)).astype(np.float32),
        "lengths": np.array([40, 30, 20], dtype=np.int32),
        "subject": np.array(["10", "9", "9"]),
        "action": np.array(["1", "1", "1"]),
        "trial": np.array(["1", "1", "1"]),
        "rate_hz": np.float32(30.0),
    }


@pytest.fixture
def utd(tmp_path: Path) -> Path:
    folder = tmp_path / "utd"
    for name in ("a10_s1_t1", "a2_s1_t2", "a2_s1_t1", "a1_s3_t4"):
        write_mat(folder / "Skeleton", f"{name}_skeleton.mat")
    return folder


def describe(clips: list[Clip]) -> list[tuple[str, str, str]]:
    return [(clip.subject, clip.action, clip.trial) for clip in clips]


def test_a_folder_is_searched_and_ordered_by_number(utd: Path) -> None:
    clips = load_clips(utd)
    assert describe(clips) == [("1", "2", "1"), ("1", "2", "2"), ("1", "10", "1"), ("3", "1", "4")]
    assert {(clip.source, clip.rate_hz, len(clip.poses)) for clip in clips} == {
        ("utd-mhad", 30, 40)
    }
    assert clips[0].person == ("utd-mhad", "1")


def test_only_chosen_subjects_and_trials_are_read(utd: Path) -> None:
    assert describe(load_clips(utd, subjects=["1"], trials=["1"])) == [
        ("1", "2", "1"),
        ("1", "10", "1"),
    ]
    assert load_clips(utd, subjects=["99"]) == []


def test_one_string_is_not_a_collection_of_subjects(utd: Path) -> None:
    with pytest.raises(TypeError, match="collection of strings"):
        load_clips(utd, subjects="10")


def test_zip_and_folder_give_the_same_clips(utd: Path, tmp_path: Path) -> None:
    archive = tmp_path / "published" / "Skeleton.zip"
    archive.parent.mkdir()
    with zipfile.ZipFile(archive, "w") as file:
        for mat in sorted(utd.rglob("*.mat")):
            file.write(mat, f"Skeleton/{mat.name}")
    assert data_hash(load_clips(archive)) == data_hash(load_clips(utd))
    assert data_hash(load_clips(archive.parent)) == data_hash(load_clips(utd))


def test_a_single_mat_is_read(utd: Path) -> None:
    assert describe(load_clips(next(utd.rglob("a1_s3*")))) == [("3", "1", "4")]


def test_an_npz_is_cut_into_its_sequences(tmp_path: Path) -> None:
    arrays = npz_arrays()
    np.savez(tmp_path / "lab.npz", **arrays)
    clips = load_clips(tmp_path / "lab.npz")
    assert [(c.source, c.subject, len(c.poses)) for c in clips] == [
        ("lab", "9", 30),
        ("lab", "9", 20),
        ("lab", "10", 40),
    ]
    assert np.array_equal(clips[1].poses, arrays["frames"][70:])
    assert [c.subject for c in load_clips(tmp_path, subjects=["10"])] == ["10"]


BAD = {
    "lengths add up to 91": {"lengths": np.array([40, 30, 21])},
    "positive integers": {"lengths": np.array([40, 50, 0])},
    "floats of shape": {"frames": np.zeros((90, 19, 3))},
    "subject as strings": {"subject": np.array([1, 2, 3])},
    "one per sequence": {"trial": np.array(["1"])},
    "rate_hz as one positive": {"rate_hz": np.float32(0)},
    "not finite": {"frames": np.full((90, 20, 3), np.nan)},
    "without pickles": {"action": np.array([{}, {}, {}], dtype=object)},
}


@pytest.mark.parametrize(("message", "change"), BAD.items(), ids=BAD.keys())
def test_an_npz_of_another_kind_is_refused(
    tmp_path: Path, message: str, change: dict[str, np.ndarray]
) -> None:
    np.savez(tmp_path / "bad.npz", **(npz_arrays() | change))
    with pytest.raises(RecordingError, match=rf"bad\.npz: .*{message}"):
        load_clips(tmp_path / "bad.npz")


def test_an_npz_without_a_key_says_which(tmp_path: Path) -> None:
    arrays = npz_arrays()
    del arrays["trial"]
    np.savez(tmp_path / "bad.npz", **arrays)
    with pytest.raises(RecordingError, match=r"missing \['trial'\]; expected \['frames'"):
        load_clips(tmp_path / "bad.npz")


def test_what_cannot_be_read_is_named(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("hello")
    (tmp_path / "bad.npz").write_bytes(b"PK\x03\x04")
    (tmp_path / "other.mat").write_bytes(b"")
    (tmp_path / "empty").mkdir()
    for name, message in (
        ("nowhere", "no such file"),
        ("notes.txt", "expected a folder"),
        ("bad.npz", "not a readable npz"),
        ("other.mat", "expected a name like"),
        ("empty", "expected a"),
    ):
        with pytest.raises(RecordingError, match=rf"{name}: .*{message}"):
            load_clips(tmp_path / name)


def test_the_hash_tells_every_difference(utd: Path) -> None:
    clips = load_clips(utd)
    changed = clips[0].poses.copy()
    changed[0, 0, 0] += 1e-6
    variants = [
        clips,
        clips[1:],
        [*clips[1:], clips[0]],
        [replace(clips[0], poses=changed), *clips[1:]],
        [replace(clips[0], subject="2"), *clips[1:]],
        [replace(clips[0], rate_hz=25.0), *clips[1:]],
    ]
    assert len({data_hash(variant) for variant in variants}) == len(variants)
    assert data_hash(load_clips(utd)) == data_hash(clips)


@pytest.mark.recordings
def test_the_published_recordings_are_complete(utd_mhad: Path) -> None:
    clips = load_clips(utd_mhad)
    frames = [len(clip.poses) for clip in clips]
    assert (len(clips), min(frames), max(frames), np.median(frames)) == (754, 41, 116, 66)
    assert {clip.subject for clip in clips} == {str(n) for n in range(1, 8)}
    assert all(np.isfinite(clip.poses).all() for clip in clips)
    left, right = np.concatenate([clip.poses for clip in clips])[:, [4, 8], 0].T
    assert np.median(left - right) == pytest.approx(-0.31, abs=0.01)
