import pytest

from models.baselines import DampedVelocity
from models.data.clips import Clip
from models.training.evaluate import EVERYBODY, describe_protocol, evaluate, evaluate_ridge
from tests.unit.models.conftest import believable_motion, make_clips


def test_every_method_is_scored_on_every_subject_beside_zero_velocity(clips: list[Clip]) -> None:
    rows = evaluate({"damped_velocity": DampedVelocity(15)}, clips, by_subject=True)
    found = {(row.method, row.subject) for row in rows}
    assert found == {(m, s) for m in ("zero_velocity", "damped_velocity") for s in "012"}
    assert sum(row.windows for row in rows if row.method == "zero_velocity") == 8 * 16


def test_everybody_together_is_one_row(clips: list[Clip]) -> None:
    [row] = evaluate({}, clips, by_subject=False)
    assert (row.method, row.subject, row.clips) == ("zero_velocity", EVERYBODY, 8)
    assert row.as_json()["frames"] == (2, 4, 8, 10, 13, 15)


def test_clips_shorter_than_a_window_are_told() -> None:
    with pytest.raises(ValueError, match="no clip has the 30 frames"):
        evaluate({}, make_clips(2, frames=20), by_subject=False)


def test_the_personal_ridge_needs_a_trial_that_is_not_tested() -> None:
    def clip(seed: int, subject: str, trial: str) -> Clip:
        return Clip(believable_motion(seed, 40), subject, "wave", trial, "utd-mhad")

    training = [clip(i, "13"[i % 2], str(1 + i // 2)) for i in range(8)]
    test = [clip(20, "2", "2"), clip(21, "4", "2")]
    trial = [clip(22, "2", "1")]
    rows = evaluate_ridge(training, [*training, *test, *trial], test)
    assert [(row.method, row.subject) for row in rows] == [
        ("ridge", "2"),
        ("ridge_personal", "2"),
        ("ridge", "4"),
    ]


def test_the_protocol_says_what_was_measured(clips: list[Clip]) -> None:
    protocol = describe_protocol(clips, model={"sha256": "abc"})
    assert protocol["stride"] == 1
    assert protocol["trials"] == ["1"]
    assert protocol["model"] == {"sha256": "abc"}
