import numpy as np
import pytest

from models.data.clips import Clip
from models.data.splits import (
    EXAMINATION,
    TEST_SUBJECTS,
    TRAIN_SUBJECTS,
    leave_people_out,
    only_tests,
    select,
    split_by_clip,
    split_by_person,
    without_examination,
)

POSES = np.zeros((30, 20, 3), dtype=np.float32)


def clip(source: str, subject: str, action: str = "1", trial: str = "1") -> Clip:
    return Clip(POSES, subject, action, trial, source)


CLIPS = [
    clip(source, subject, action, trial)
    for source, subject in (("utd-mhad", "1"), ("utd-mhad", "7"), ("precog", "7"), ("wmft", "14"))
    for action in "12345"
    for trial in "12"
]


def test_nobody_is_trained_on_and_tested() -> None:
    assert not set(TRAIN_SUBJECTS) & set(TEST_SUBJECTS)


def test_the_people_of_the_examination_never_train() -> None:
    assert len(EXAMINATION) == 8
    tested = [clip("utd-mhad", subject) for subject in TEST_SUBJECTS]
    assert all(only_tests(c.person) for c in tested)
    assert {c.person for c in without_examination(CLIPS + tested)} == {
        ("utd-mhad", "1"),
        ("utd-mhad", "7"),
        ("wmft", "14"),
    }


def test_clips_are_selected_by_subject_and_trial() -> None:
    chosen = select(CLIPS, subjects=["7"], trials=["2"])
    assert {(c.subject, c.trial) for c in chosen} == {("7", "2")}
    assert len(chosen) == 10
    assert select(CLIPS) == CLIPS


def test_the_same_name_in_two_collections_is_two_people() -> None:
    split = split_by_person(CLIPS, [("precog", "7")])
    assert {c.person for c in split.held_out} == {("precog", "7")}
    assert ("utd-mhad", "7") in {c.person for c in split.train}
    with pytest.raises(ValueError, match="no clips of"):
        split_by_person(CLIPS, [("precog", "70")])


def test_each_person_is_left_out_once() -> None:
    folds = dict(leave_people_out(CLIPS))
    assert len(folds) == 4
    for person, split in folds.items():
        assert {c.person for c in split.held_out} == {person}
        assert person not in {c.person for c in split.train}
        assert len(split.train) + len(split.held_out) == len(CLIPS)
    with pytest.raises(ValueError, match="at least two"):
        list(leave_people_out(CLIPS[:10]))


def test_a_split_by_clip_takes_a_share_of_everybody() -> None:
    split = split_by_clip(CLIPS, share=0.2, seed=1)
    counts = {p: sum(c.person == p for c in split.held_out) for p in {c.person for c in CLIPS}}
    assert set(counts.values()) == {2}
    assert not {id(c) for c in split.train} & {id(c) for c in split.held_out}
    assert len(split.train) + len(split.held_out) == len(CLIPS)


def test_the_seed_decides_the_split() -> None:
    first, again, other = (split_by_clip(CLIPS, share=0.2, seed=seed) for seed in (1, 1, 2))
    assert first == again
    assert first.held_out != other.held_out


def test_shares_and_people_that_cannot_be_split_are_refused() -> None:
    with pytest.raises(ValueError, match="between 0 and 1"):
        split_by_clip(CLIPS, share=1.0, seed=0)
    with pytest.raises(ValueError, match="only clip"):
        split_by_clip([clip("utd-mhad", "1")], share=0.5, seed=0)
