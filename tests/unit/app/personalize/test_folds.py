import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from app.personalize.folds import GAP_FRAMES, MIN_BLOCKS, Fold, cut_blocks, make_folds
from models.data.clips import Clip


def make_clip(number: int, frames: int, *, action: str = "", trial: str = "a") -> Clip:
    """A clip whose every pose tells which clip and frame it is."""
    poses = np.zeros((frames, 20, 3), np.float32)
    poses[:, 0, 0], poses[:, 0, 1] = number, np.arange(frames)
    return Clip(poses, "", action, trial, "kinecast")


def frames_of(clips: tuple[Clip, ...]) -> set[tuple[int, int]]:
    return {(int(pose[0, 0]), int(pose[0, 1])) for clip in clips for pose in clip.poses}


def actions_of(clips: tuple[Clip, ...]) -> set[str]:
    return {clip.action for clip in clips}


def test_long_clips_become_blocks_with_a_gap_between() -> None:
    blocks = cut_blocks([make_clip(0, 120), make_clip(1, 300), make_clip(2, 29)])
    assert [len(block.poses) for block in blocks] == [120, 75, 75, 75]
    assert [int(block.poses[0, 0, 1]) for block in blocks[1:]] == [0, 105, 210]


def test_too_few_blocks_give_no_fold() -> None:
    few = [make_clip(i, 70) for i in range(MIN_BLOCKS - 1)]
    assert make_folds(few) == []
    assert make_folds([*few, make_clip(9, 70)])


def test_with_one_trial_later_parts_and_whole_motions_are_left_out() -> None:
    folds = make_folds([make_clip(i, 70, action=f"a{i}") for i in range(12)])
    assert len(folds) == 2
    for fold in folds:
        assert len(fold.unlike) == 3
        assert len(fold.like) == 3
        assert not actions_of(fold.unlike) & actions_of(fold.learn)
        assert actions_of(fold.like) <= actions_of(fold.learn)
        assert not frames_of(fold.learn) & frames_of((*fold.like, *fold.unlike))
    assert not actions_of(folds[0].like) & actions_of(folds[1].like)
    assert not actions_of(folds[0].unlike) & actions_of(folds[1].unlike)


def test_earlier_and_later_parts_share_no_frame_of_any_window() -> None:
    fold = make_folds([make_clip(i, 80) for i in range(5)])[0]
    later = fold.like[0]
    earlier = next(c for c in fold.learn if c.poses[0, 0, 0] == later.poses[0, 0, 0])
    last_learnt = int(earlier.poses[-1, 0, 1]) - 29
    assert int(later.poses[0, 0, 1]) - last_learnt == GAP_FRAMES
    assert len(later.poses) >= 30


def test_another_repetition_is_left_out_where_there_is_one() -> None:
    clips = [make_clip(10 * i + k, 50, action=f"a{i}") for i in range(6) for k in range(3)]
    fold = make_folds(clips)[0]
    assert fold.like
    assert all(len(clip.poses) == 50 for clip in fold.like)
    assert actions_of(fold.like) <= actions_of(fold.learn)
    assert len(fold.unlike) % 3 == 0  # whole motions, with all their repetitions


def test_with_several_trials_each_is_left_out_in_turn_the_newest_alone() -> None:
    clips = [
        make_clip(100 * t + i, 60, action=f"a{i}", trial=f"t{t}")
        for t in range(4)
        for i in range(8)
    ]
    folds = make_folds(clips)
    assert [fold.trial for fold in folds] == ["t3", "t0, t2", "t1", ""]
    for fold in folds[:-1]:
        assert {clip.trial for clip in fold.like} == set(fold.trial.split(", "))
        assert not {clip.trial for clip in fold.learn} & {clip.trial for clip in fold.like}
    motions = folds[-1]
    assert len(actions_of(motions.unlike)) == 2
    assert not actions_of(motions.unlike) & actions_of(motions.learn)
    assert {clip.trial for clip in motions.unlike} == {"t0", "t1", "t2", "t3"}


@pytest.mark.parametrize("sizes", [(1, 17), (17, 1), (1, 1, 1, 17), (3, 27)])
def test_a_short_take_beside_a_trial_does_not_hide_what_that_teaches(sizes) -> None:
    blocks = [
        make_clip(100 * t + i, 70, action=f"a{i}", trial=f"t{t}")
        for t, size in enumerate(sizes)
        for i in range(size)
    ]
    folds = make_folds(blocks)
    assert folds
    assert not any(fold.trial for fold in folds)
    assert all(len(fold.learn) >= len(blocks) // 2 for fold in folds)


def test_without_labels_motions_of_the_newest_trial_alone_are_left_out() -> None:
    clips = [make_clip(100 * t + i, 60, trial=f"t{t}") for t in range(2) for i in range(8)]
    motions = make_folds(clips)[-1]
    assert {clip.trial for clip in (*motions.unlike, *motions.learn)} == {"t1"}


@settings(deadline=None)
@given(
    st.lists(
        st.tuples(
            st.integers(20, 400), st.sampled_from(["", "a", "b", "c"]), st.sampled_from("xyz")
        ),
        max_size=14,
    )
)
def test_whatever_is_recorded_nothing_is_both_learnt_and_left_out(
    made: list[tuple[int, str, str]],
) -> None:
    clips = [make_clip(i, n, action=action, trial=t) for i, (n, action, t) in enumerate(made)]
    blocks = cut_blocks(clips)
    folds = make_folds(blocks)
    assert bool(folds) == (len(blocks) >= MIN_BLOCKS)
    for fold in folds:
        check_fold(fold)


def check_fold(fold: Fold) -> None:
    assert not frames_of(fold.learn) & frames_of((*fold.like, *fold.unlike))
    assert fold.learn
    assert all(len(clip.poses) >= 30 for clip in (*fold.learn, *fold.like, *fold.unlike))


def test_every_first_trial_of_five_blocks_can_be_judged_by_motion_unlike_it() -> None:
    for count in range(MIN_BLOCKS, 30):
        folds = make_folds([make_clip(i, 60) for i in range(count)])
        assert sum(len(fold.unlike) for fold in folds) >= 2, count


@given(st.integers(1, 12), st.integers(1, 12))
def test_every_second_trial_can_be_judged_by_motion_left_out(first: int, second: int) -> None:
    clips = [make_clip(i, 70, trial="a" if i < first else "b") for i in range(first + second)]
    folds = make_folds(clips)
    if len(clips) < MIN_BLOCKS:
        assert folds == []
        return
    assert sum(len(fold.unlike) for fold in folds) >= 2
    for fold in folds:
        assert not frames_of(fold.learn) & frames_of(fold.unlike)


def test_of_one_long_take_later_parts_are_left_out_as_well() -> None:
    folds = make_folds(cut_blocks([make_clip(0, 900)]))
    for fold in folds:
        assert fold.like
        assert all(len(clip.poses) >= 30 + 5 for clip in fold.like)
        assert not frames_of(fold.learn) & frames_of(fold.like)
