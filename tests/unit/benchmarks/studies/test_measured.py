import json

import numpy as np
import pytest

from benchmarks.studies.measured import Measured, average, join, measure
from benchmarks.studies.recordings import read_person
from models.baselines import DampedVelocity
from models.data.windows import cut_windows
from models.metrics import FRAMES
from models.spec import MotionSpec
from models.training.evaluate import score_forecaster


@pytest.fixture(scope="module")
def clips(place):
    return read_person(place, "utd-mhad/2", "1", "2")


@pytest.fixture(scope="module")
def found(clips):
    return measure({"damped": DampedVelocity()}, clips)


def test_errors_are_those_of_the_protocol(found, clips):
    scores = score_forecaster(DampedVelocity(), cut_windows(clips, MotionSpec()))
    np.testing.assert_allclose(found.cm2("damped"), scores.mse_cm2, rtol=1e-9)
    assert "zero_velocity" in found.sums


def test_json_keeps_what_is_needed(found):
    kept = Measured.from_json(json.loads(json.dumps(found.as_json())))
    np.testing.assert_allclose(kept.cm2("damped"), found.cm2("damped"), rtol=1e-5)
    assert kept.actions == found.actions
    assert kept.trials == found.trials


def test_picking_actions_and_joining_them_again_is_the_whole(found):
    parts = [found.pick_action(action) for action in dict.fromkeys(found.actions)]
    assert all(len(set(part.actions)) == 1 for part in parts)
    np.testing.assert_allclose(join(parts).cm2("damped"), found.cm2("damped"))


def test_ratios_at_a_frame_and_over_the_table(found):
    last = found.compare("damped", "zero_velocity")[FRAMES[-1]]
    assert found.ratio("damped", "zero_velocity") == pytest.approx(last.value)
    assert found.mean_ratio("zero_velocity", "zero_velocity") == 1.0


def test_averaging_equal_runs_changes_nothing(found):
    assert average([found, found]).cm2("damped") == pytest.approx(found.cm2("damped"))


def test_clips_without_a_window_are_left_out(clips):
    short = [type(clips[0])(clips[0].poses[:20], "2", "9", "1", "utd-mhad"), *clips[:2]]
    assert len(measure({}, short).actions) == 2
