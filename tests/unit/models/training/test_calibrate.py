from dataclasses import replace

import pytest

from models.checkpoint import Checkpoint, dump_checkpoint, load_checkpoint
from models.data.clips import Clip
from models.data.windows import cut_windows
from models.spec import MotionSpec
from models.training.calibrate import calibrate, measure_coverage
from models.training.config import PretrainConfig
from models.training.pretrain import pretrain


@pytest.fixture
def fold(config: PretrainConfig, clips: list[Clip]) -> Checkpoint:
    result = pretrain(clips, replace(config, steps=1), leave_out=[("utd-mhad", "1")])
    return load_checkpoint(dump_checkpoint(result.predictor, result.metadata))


def test_the_radius_covers_the_people_it_was_measured_on(
    fold: Checkpoint, clips: list[Clip]
) -> None:
    radius, scores = calibrate([fold], clips)
    assert radius.calibrated_on == "utd-mhad/1"
    assert set(scores) == {"utd-mhad/1"}
    windows = cut_windows([c for c in clips if c.subject == "1"], MotionSpec())
    found = measure_coverage(fold.predictor, radius, windows)
    assert all(abs(share - level) < 0.03 for level, share in found.items())


def test_a_fold_without_recordings_of_its_people_is_refused(
    fold: Checkpoint, clips: list[Clip]
) -> None:
    with pytest.raises(ValueError, match="utd-mhad/1"):
        calibrate([fold], [clip for clip in clips if clip.subject != "1"])


def test_a_coverage_that_was_not_calibrated_is_refused(fold: Checkpoint, clips: list[Clip]) -> None:
    radius, _ = calibrate([fold], clips)
    with pytest.raises(ValueError, match=r"not calibrated at \[0.77\]"):
        measure_coverage(fold.predictor, radius, cut_windows(clips, MotionSpec()), levels=(0.77,))
