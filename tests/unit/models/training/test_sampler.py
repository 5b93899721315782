from dataclasses import replace

import pytest
import torch

from models.data.clips import Clip
from models.training.sampler import Drawn, WindowSampler, list_actions
from tests.unit.models.conftest import make_clips

CPU = torch.device("cpu")


def make_sampler(
    clips: list[Clip],
    tempo: float = 0.0,
    batch: int = 20,
    pools: tuple[tuple[str, ...], ...] = (),
    slow: float = 0.0,
    labels: tuple[tuple[str, str], ...] = (),
) -> WindowSampler:
    shares = {"utd-mhad": 0.5}
    return WindowSampler(
        clips,
        length=30,
        batch=batch,
        shares=shares,
        pools=pools,
        tempo=tempo,
        slow=slow,
        device=CPU,
        labels=labels,
    )


def measure_speed(drawn: Drawn) -> torch.Tensor:
    return drawn.windows.diff(dim=1).norm(dim=-1).mean(dim=(1, 2))


def test_a_batch_holds_each_source_in_its_share() -> None:
    clips = make_clips(4) + make_clips(2, source="a") + make_clips(3, source="b")
    assert [group.share for group in make_sampler(clips).groups.values()] == [5, 5, 10]
    assert [len(part.windows) for part in make_sampler(clips).draw()] == [5, 5, 10]


def test_pools_are_drawn_together() -> None:
    clips = make_clips(4) + make_clips(2, source="a") + make_clips(3, source="b")
    sampler = make_sampler(clips, pools=(("utd-mhad", "a"), ("elsewhere",)))
    assert sampler.parts == [["a", "utd-mhad"], ["b"]]
    assert [len(part.windows) for part in sampler.draw()] == [15, 5]


def test_odd_batches_are_filled_to_the_last_window() -> None:
    clips = make_clips(4) + make_clips(2, source="a") + make_clips(3, source="b")
    assert sum(len(part.windows) for part in make_sampler(clips, batch=19).draw()) == 19


def test_windows_are_consecutive_frames_of_one_clip(clips: list[Clip]) -> None:
    torch.manual_seed(0)
    every = {clip.poses[s : s + 30].tobytes() for clip in clips for s in range(16)}
    [drawn] = make_sampler(clips).draw()
    assert all(window.numpy().tobytes() in every for window in drawn.windows)


def test_tempo_changes_speed_but_never_leaves_the_clip(clips: list[Clip]) -> None:
    torch.manual_seed(0)
    plain, varied = make_sampler(clips, 0.0, 400), make_sampler(clips, 0.3, 400)
    speed = [measure_speed(sampler.draw()[0]) for sampler in (plain, varied)]
    assert speed[1].std() > speed[0].std() * 1.02
    lowest = min(clip.poses.min() for clip in clips)
    highest = max(clip.poses.max() for clip in clips)
    assert lowest <= varied.draw()[0].windows.min()
    assert varied.draw()[0].windows.max() <= highest


def test_slowed_windows_move_at_any_speed_down_to_none(clips: list[Clip]) -> None:
    torch.manual_seed(0)
    [slow] = make_sampler(clips, batch=400, slow=1.0).draw()
    [plain] = make_sampler(clips, batch=400).draw()
    speed = [measure_speed(part) for part in (slow, plain)]
    assert speed[0].min() < 0.1 * speed[1].min()
    assert speed[0].mean() < 0.7 * speed[1].mean()


def test_clips_that_are_too_short_are_told() -> None:
    with pytest.raises(ValueError, match="none of 2 clips has the 30 frames"):
        make_sampler(make_clips(2, frames=29))


def test_windows_are_labelled_with_the_action_of_their_clip() -> None:
    clips = make_clips(4) + make_clips(6, source="elsewhere")[4:]
    labels = list_actions(clips, "utd-mhad")
    assert labels == sorted(labels)
    action_of = {
        clip.poses[s : s + 30].tobytes(): (clip.source, clip.action)
        for clip in clips
        for s in range(len(clip.poses) - 29)
    }
    for part in make_sampler(clips, batch=60, labels=tuple(labels)).draw():
        for window, label in zip(part.windows, part.labels, strict=True):
            action = action_of[window.numpy().tobytes()]
            assert [labels[i] for i in label.nonzero()[:, 0]] == [
                a for a in [action] if a in labels
            ]


def test_windows_are_labelled_with_the_part_of_the_action_that_they_show() -> None:
    [clip] = make_clips(1)
    sampler = WindowSampler(
        [clip],
        length=30,
        batch=200,
        shares={},
        pools=(),
        tempo=0.0,
        slow=0.0,
        device=CPU,
        labels=[("elsewhere", "0"), (clip.source, clip.action)],
        moments=4,
    )
    start = {clip.poses[s : s + 30].tobytes(): s for s in range(len(clip.poses) - 29)}
    [drawn] = sampler.draw()
    assert drawn.labels.shape == (200, 8)
    for window, label in zip(drawn.windows, drawn.labels, strict=True):
        middle = start[window.numpy().tobytes()] + 15
        assert label.nonzero()[:, 0].tolist() == [4 + middle * 4 // len(clip.poses)]


def test_actions_are_listed_in_the_order_of_their_numbers() -> None:
    clips = [replace(clip, action=name) for clip, name in zip(make_clips(3), "102", strict=True)]
    clips.append(replace(clips[0], action="10"))
    named = [action for _, action in list_actions(clips, "utd-mhad")]
    assert named == ["0", "1", "2", "10"]
    assert list_actions(clips, "elsewhere") == []
