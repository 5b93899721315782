import pytest
import torch

from models.data.clips import Clip
from models.training.sampler import WindowSampler
from tests.unit.models.conftest import make_clips

CPU = torch.device("cpu")


def make_sampler(
    clips: list[Clip],
    tempo: float = 0.0,
    batch: int = 20,
    pools: tuple[tuple[str, ...], ...] = (),
    slow: float = 0.0,
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
    )


def test_a_batch_holds_each_source_in_its_share() -> None:
    clips = make_clips(4) + make_clips(2, source="a") + make_clips(3, source="b")
    assert [group.share for group in make_sampler(clips).groups.values()] == [5, 5, 10]
    assert [len(part) for part in make_sampler(clips).draw()] == [5, 5, 10]


def test_pools_are_drawn_together() -> None:
    clips = make_clips(4) + make_clips(2, source="a") + make_clips(3, source="b")
    sampler = make_sampler(clips, pools=(("utd-mhad", "a"), ("elsewhere",)))
    assert sampler.parts == [["a", "utd-mhad"], ["b"]]
    assert [len(part) for part in sampler.draw()] == [15, 5]


def test_odd_batches_are_filled_to_the_last_window() -> None:
    clips = make_clips(4) + make_clips(2, source="a") + make_clips(3, source="b")
    assert sum(map(len, make_sampler(clips, batch=19).draw())) == 19


def test_windows_are_consecutive_frames_of_one_clip(clips: list[Clip]) -> None:
    torch.manual_seed(0)
    every = {clip.poses[s : s + 30].tobytes() for clip in clips for s in range(16)}
    [drawn] = make_sampler(clips).draw()
    assert all(window.numpy().tobytes() in every for window in drawn)


def test_tempo_changes_speed_but_never_leaves_the_clip(clips: list[Clip]) -> None:
    torch.manual_seed(0)
    plain, varied = make_sampler(clips, 0.0, 400), make_sampler(clips, 0.3, 400)
    speed = [s.draw()[0].diff(dim=1).norm(dim=-1).mean(dim=(1, 2)) for s in (plain, varied)]
    assert speed[1].std() > speed[0].std() * 1.02
    lowest = min(clip.poses.min() for clip in clips)
    highest = max(clip.poses.max() for clip in clips)
    assert lowest <= varied.draw()[0].min()
    assert varied.draw()[0].max() <= highest


def test_slowed_windows_move_at_any_speed_down_to_none(clips: list[Clip]) -> None:
    torch.manual_seed(0)
    [slow] = make_sampler(clips, batch=400, slow=1.0).draw()
    [plain] = make_sampler(clips, batch=400).draw()
    speed = [part.diff(dim=1).norm(dim=-1).mean(dim=(1, 2)) for part in (slow, plain)]
    assert speed[0].min() < 0.1 * speed[1].min()
    assert speed[0].mean() < 0.7 * speed[1].mean()


def test_clips_that_are_too_short_are_told() -> None:
    with pytest.raises(ValueError, match="none of 2 clips has the 30 frames"):
        make_sampler(make_clips(2, frames=29))
