import contextlib
import io
import struct
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from hypothesis import example, given, settings
from hypothesis import strategies as st

from models.data import utd_mhad
from models.data.utd_mhad import MatName, RecordingError, find_mats, parse_name, read_mat, read_zip


def mat(skeleton: object, *, name: str = "d_skel", compressed: bool = True) -> bytes:
    buffer = io.BytesIO()
    scipy.io.savemat(buffer, {name: skeleton}, do_compression=compressed)
    return buffer.getvalue()


SKELETON = np.random.default_rng(0).normal(size=(20, 3, 45))
GOOD = mat(SKELETON)


def test_poses_come_time_first_in_metres() -> None:
    poses = read_mat(GOOD)
    assert poses.shape == (45, 20, 3)
    assert poses.dtype == np.float32
    assert np.allclose(poses[7, 4], SKELETON[4, :, 7])


def test_a_path_is_read_as_well(tmp_path: Path) -> None:
    file = tmp_path / "a1_s1_t1_skeleton.mat"
    file.write_bytes(GOOD)
    assert np.array_equal(read_mat(file), read_mat(GOOD))


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("a10_s2_t4_skeleton.mat", MatName(action="10", subject="2", trial="4")),
        ("Skeleton/a1_s8_t1_skeleton.mat", MatName(action="1", subject="8", trial="1")),
        ("a1_s8_t1_inertial.mat", None),
        ("__MACOSX/._a1_s8_t1_skeleton.mat", None),
        ("a1_s8_t1_skeleton.mat.txt", None),
    ],
)
def test_names_say_who_did_what(name: str, expected: MatName | None) -> None:
    assert parse_name(name) == expected


@pytest.mark.parametrize(
    "content",
    [
        mat(SKELETON, name="other"),
        mat(SKELETON[:19]),
        mat(SKELETON[:, :2]),
        mat(np.zeros((20, 3, 0))),
        mat("text"),
        mat(SKELETON.astype(complex)),
        mat(np.zeros((20, 3, utd_mhad.MAX_FRAMES + 1))),
    ],
)
def test_other_contents_are_refused_with_what_was_expected(content: bytes) -> None:
    with pytest.raises(
        RecordingError, match=r"clip 7: expected a variable d_skel .* \[20, 3, frames\]"
    ):
        read_mat(content, name="clip 7")


@pytest.mark.parametrize("value", [np.nan, -np.inf, 1e300, 850.0])
def test_values_that_no_sensor_gives_are_refused(value: float) -> None:
    broken = SKELETON.copy()
    broken[3, 1, 4] = value
    with pytest.raises(RecordingError, match="not finite"):
        read_mat(mat(broken))


@pytest.mark.parametrize(
    "content",
    [b"", b"hello", GOOD[:100], GOOD[:-50], b"\x89HDF\r\n\x1a\n" * 40],
    ids=["empty", "text", "header", "cut", "hdf"],  # a header holds the time of its writing
)
def test_damaged_files_are_refused_by_name(content: bytes) -> None:
    with pytest.raises(RecordingError, match=r"^clip 7: "):
        read_mat(content, name="clip 7")


@settings(max_examples=60, deadline=None)
@example(place=144, change=16, compressed=False)
@example(place=192, change=1, compressed=False)  # an unknown kind of numbers
@example(place=193, change=1, compressed=False)
@given(st.integers(0, len(GOOD) - 1), st.integers(1, 255), st.booleans())
def test_no_damage_escapes_as_another_error(place: int, change: int, compressed: bool) -> None:
    content = bytearray(GOOD if compressed else mat(SKELETON, compressed=False))
    content[place] ^= change
    with contextlib.suppress(RecordingError):
        assert read_mat(bytes(content)).shape[1:] == (20, 3)


def pack(array: bytes) -> bytes:
    packed = zlib.compress(array)
    return GOOD[:128] + struct.pack("<II", 15, len(packed)) + packed


def test_a_packed_array_that_says_that_it_ends_early_is_refused() -> None:
    plain = bytearray(mat(SKELETON, compressed=False)[128:])
    tag = plain.index(b"d_skel") + 8
    plain[4:8] = struct.pack("<I", tag - 8)
    plain[tag : tag + 4] = struct.pack("<I", 300)
    with pytest.raises(RecordingError, match="clip 7: not a readable MATLAB file"):
        read_mat(pack(bytes(plain)), name="clip 7")


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_no_damage_inside_of_a_packed_array_escapes_as_another_error(data: st.DataObject) -> None:
    plain = bytearray(mat(SKELETON, compressed=False)[128:])
    for _ in range(data.draw(st.integers(1, 3))):
        place = data.draw(st.integers(0, 80))
        plain[place] = data.draw(st.integers(0, 255))
    with contextlib.suppress(RecordingError):
        assert read_mat(pack(bytes(plain))).shape[1:] == (20, 3)


def test_other_variables_beside_the_skeleton_are_passed_over() -> None:
    buffer = io.BytesIO()
    beside = {"note": "a text", "cells": np.array([1, "two"], dtype=object), "zeros": np.zeros(9)}
    scipy.io.savemat(buffer, beside | {"d_skel": SKELETON}, do_compression=True)
    assert np.array_equal(read_mat(buffer.getvalue()), read_mat(GOOD))


@pytest.mark.parametrize("compressed", [True, False])
def test_a_recording_of_the_longest_kind_is_read(compressed: bool) -> None:
    longest = np.random.default_rng(1).normal(size=(20, 3, utd_mhad.MAX_FRAMES))
    poses = read_mat(mat(longest, compressed=compressed))
    assert np.array_equal(poses, longest.transpose(2, 0, 1).astype(np.float32))


@pytest.mark.parametrize("kind", ["f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8"])
def test_other_kinds_of_numbers_are_read(kind: str) -> None:
    whole = np.arange(20 * 3 * 2).reshape(20, 3, 2) % 90
    assert np.array_equal(read_mat(mat(whole.astype(kind)))[1, 4], whole[4, :, 1])


def test_a_missing_file_is_an_error_that_names_it(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="nowhere"):
        read_mat(tmp_path / "nowhere.mat")


def test_files_are_found_at_any_depth_in_a_fixed_order(tmp_path: Path) -> None:
    (tmp_path / "b" / "c").mkdir(parents=True)
    for place in ("b/c/a1_s1_t1_skeleton.mat", "a2_s1_t1_skeleton.mat", "b/notes.mat"):
        (tmp_path / place).write_bytes(GOOD)
    assert [p.name for p in find_mats(tmp_path)] == [
        "a2_s1_t1_skeleton.mat",
        "a1_s1_t1_skeleton.mat",
    ]


def make_zip(path: Path, members: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return path


def test_the_published_zip_is_read_in_place(tmp_path: Path) -> None:
    path = make_zip(
        tmp_path / "Skeleton.zip",
        {"Skeleton/a2_s1_t1_skeleton.mat": GOOD, "Skeleton/a1_s1_t1_skeleton.mat": GOOD, "x": b""},
    )
    names = [name for name, _ in read_zip(path)]
    assert names == ["Skeleton/a1_s1_t1_skeleton.mat", "Skeleton/a2_s1_t1_skeleton.mat"]
    assert list(tmp_path.iterdir()) == [path]


def test_a_member_that_would_fill_the_memory_is_refused(tmp_path: Path) -> None:
    large = bytes(utd_mhad.MAX_MEMBER_BYTES + 1)
    path = make_zip(tmp_path / "Skeleton.zip", {"a1_s1_t1_skeleton.mat": large})
    assert path.stat().st_size < 100_000
    with pytest.raises(RecordingError, match="larger than"):
        list(read_zip(path))


def test_zips_without_recordings_and_broken_ones_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="expected a\\*_s\\*"):
        list(read_zip(make_zip(tmp_path / "other.zip", {"readme": b""})))
    broken = tmp_path / "broken.zip"
    broken.write_bytes(b"PK\x03\x04 not really")
    with pytest.raises(RecordingError, match=r"broken\.zip: not a readable zip"):
        list(read_zip(broken))


def test_a_zip_of_endless_members_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(utd_mhad, "MAX_MEMBERS", 1)
    names = {f"a{n}_s1_t1_skeleton.mat": b"" for n in range(2)}
    with pytest.raises(RecordingError, match="more than 1 files"):
        list(read_zip(make_zip(tmp_path / "many.zip", names)))
