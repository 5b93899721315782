import numpy as np
import pytest

from models.data.clips import Clip
from models.data.windows import cut_windows, pack, window_starts
from models.spec import MotionSpec

SPEC = MotionSpec()


def numbered(length: int, first: int, rate_hz: float = 30.0) -> Clip:
    """A clip whose every coordinate is the number of its frame."""
    frames = np.arange(first, first + length, dtype=np.float32)
    poses = np.broadcast_to(frames[:, None, None], (length, 20, 3)).copy()
    return Clip(poses, "1", "1", "1", "test", rate_hz)


CLIPS = [numbered(32, 0), numbered(12, 1000), numbered(30, 2000)]


def test_windows_never_cross_the_end_of_a_clip() -> None:
    windows = cut_windows(CLIPS, SPEC)
    assert len(windows) == 3 + 1
    assert windows.clip.tolist() == [0, 0, 0, 2]
    assert windows.start.tolist() == [0, 1, 2, 0]
    frames = np.concatenate([windows.observed, windows.future], axis=1)[..., 0, 0]
    assert (np.diff(frames, axis=1) == 1).all()
    assert frames[:, 0].tolist() == [0, 1, 2, 2000]


def test_observed_and_future_have_the_lengths_of_the_spec() -> None:
    windows = cut_windows(CLIPS, MotionSpec(observe=10, horizon=5), stride=7)
    assert windows.observed.shape[1:] == (10, 20, 3)
    assert windows.future.shape[1:] == (5, 20, 3)
    assert windows.start[windows.clip == 0].tolist() == [0, 7, 14]
    assert windows.observed.dtype == windows.future.dtype == np.float32


def test_a_trainer_can_gather_the_same_windows_from_the_packed_clips() -> None:
    packed = pack(CLIPS)
    starts = window_starts(packed, SPEC)
    assert packed.offsets.tolist() == [0, 32, 44]
    assert packed.lengths.tolist() == [32, 12, 30]
    assert starts.tolist() == [0, 1, 2, 44]
    assert packed.find_clips(starts).tolist() == [0, 0, 0, 2]
    gathered = packed.frames[starts[:, None] + np.arange(SPEC.frames)]
    assert np.array_equal(gathered[:, :15], cut_windows(CLIPS, SPEC).observed)


def test_nothing_to_cut_is_an_error() -> None:
    with pytest.raises(ValueError, match="30 frames of a window"):
        cut_windows([CLIPS[1]], SPEC)
    with pytest.raises(ValueError, match="no clips"):
        cut_windows([], SPEC)
    with pytest.raises(ValueError, match="stride"):
        cut_windows(CLIPS, SPEC, stride=0)


def test_clips_at_another_rate_are_refused() -> None:
    with pytest.raises(ValueError, match=r"25\.0 Hz, not 30\.0"):
        cut_windows([numbered(40, 0, rate_hz=25.0)], SPEC)
