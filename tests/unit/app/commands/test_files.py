"""Recordings that researchers' commands read."""

from pathlib import Path

import numpy as np
import pytest

from app.commands.files import read_clips, read_more_people
from models.data.synthetic import SyntheticPerson


def write_npz(path: Path, rate_hz: float, subject: str = "1") -> Path:
    poses = SyntheticPerson(1).record("wave", 2.0, rate_hz=rate_hz).astype(np.float32)
    labels = {name: np.array(["1"]) for name in ("action", "trial")}
    labels["subject"] = np.array([subject])
    lengths = np.array([len(poses)])
    np.savez(path, frames=poses, lengths=lengths, rate_hz=np.array(rate_hz), **labels)
    return path


def test_recordings_at_the_rate_of_the_net_are_read(tmp_path: Path) -> None:
    (clip,) = read_clips(write_npz(tmp_path / "mine.npz", 30.0), None)
    assert clip.poses.shape == (60, 20, 3)


def test_recordings_at_another_rate_are_refused_in_a_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_npz(tmp_path / "quick.npz", 60.0)
    with pytest.raises(SystemExit) as stopped:
        read_clips(path, None)
    assert stopped.value.code == 2
    told = " ".join(capsys.readouterr().err.split())
    assert told.endswith("quick has 60 Hz; bring it to 30 Hz first")


def test_people_who_only_test_are_never_mixed_into_training(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for number, subject in enumerate(("1", "2", "4", "6", "7")):
        (tmp_path / str(number)).mkdir()
        path = write_npz(tmp_path / str(number) / "utd-mhad.npz", 30.0, subject)
        trains = {clip.person for clip in read_more_people(path)}
        assert trains == ({("utd-mhad", subject)} if subject in "17" else set())
        told = " ".join(capsys.readouterr().err.split())
        said = f"Not trained on, as they only test: utd-mhad/{subject}"
        assert told == ("" if subject in "17" else said)
    assert read_more_people(None) == []
