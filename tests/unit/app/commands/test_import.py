"""What `kinecast import` says of recordings among which it cannot choose."""

import numpy as np
import pytest

from app.commands.import_ import _read
from tests.personal_support import record_frames


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    path = tmp_path_factory.mktemp("recordings") / "own.npz"
    frames = record_frames(1.0)
    np.savez(
        path,
        frames=np.concatenate([frames.joints] * 2),
        lengths=np.array([len(frames)] * 2),
        subject=np.array(["4", "5"]),
        action=np.array(["wave"] * 2),
        trial=np.array(["1", "2"]),
        rate_hz=np.float64(30.0),
    )
    return path


def refuse(capsys, data, **chosen):
    with pytest.raises(SystemExit) as caught:
        _read(data, **({"subject": None, "trials": None, "finetune": True} | chosen))
    assert caught.value.code == 2
    return capsys.readouterr().err


@pytest.mark.parametrize(
    ("chosen", "told"),
    [
        ({"subject": "99", "trials": "9"}, "no clips of subject 99 and trials 9 in "),
        ({"subject": "99"}, "no clips of subject 99 and trials any in "),
        ({"trials": "9"}, "no clips of subject any and trials 9 in "),
        ({}, "The recordings show 4, 5: choose one with --subject."),
    ],
)
def test_the_cause_is_named(recordings, capsys, chosen, told):
    shown = refuse(capsys, recordings, **chosen)
    assert told in shown
    assert ("--subject" in shown) == (not chosen)


@pytest.mark.parametrize("trials", ["x", "1;2", ","])
def test_what_is_no_list_of_trials_is_told(recordings, capsys, trials):
    """In a folder; a single file may name its trials as it likes."""
    told = f"--trials {trials} is no list of trials"
    assert told in refuse(capsys, recordings.parent, trials=trials)
    assert told not in refuse(capsys, recordings, trials=trials)


def test_blanks_in_a_list_of_trials_do_not_count(recordings):
    (batch,) = _read(recordings, subject="5", trials="1, 2", finetune=True)
    assert batch.label == "trial 2"
