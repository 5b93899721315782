from pathlib import Path

import numpy as np
import pytest

from app.live.guard import GuardRules, is_possible, measure_fastest
from app.live.window import FrameBuffer, WindowReady
from models.data.clips import load_clips
from models.data.synthetic import SyntheticPerson
from models.skeleton import KINECT_V1, SKELETONS

SDK_ORDER = [3, 2, 1, 0, *range(4, 20)]
RECORDED = SyntheticPerson(5).record("walk", 3.0).astype(np.float64)


def share_flagged(clips: list[np.ndarray]) -> dict[str, float]:
    """Share of windows that carry each flag."""
    windows, counted = (
        0,
        dict.fromkeys(("mirrored", "upside_down", "implausible_pose", "implausible_units"), 0),
    )
    for poses in clips:
        buffer = FrameBuffer(KINECT_V1)
        for i, pose in enumerate(poses):
            buffer.push(i / 30, pose)
            outcome = buffer.look()
            if isinstance(outcome, WindowReady):
                windows += 1
                for flag in counted:
                    counted[flag] += flag in outcome.flags
    return {flag: count / windows for flag, count in counted.items()}


@pytest.mark.parametrize("action", ["walk", "wave", "sit_and_work", "throw", "stand"])
def test_a_plain_person_is_not_flagged(action: str) -> None:
    clips = [SyntheticPerson(seed).record(action, 2.0).astype(np.float64) for seed in range(4)]
    assert max(share_flagged(clips).values()) == 0


def test_a_mirrored_person_is_flagged() -> None:
    assert share_flagged([RECORDED * [-1.0, 1.0, 1.0]])["mirrored"] > 0.95


def test_the_order_of_the_sdk_is_flagged() -> None:
    assert share_flagged([RECORDED[:, SDK_ORDER]])["implausible_pose"] == 1


def test_head_down_is_flagged_after_a_second() -> None:
    flagged = share_flagged([np.repeat(RECORDED[:1] * [-1.0, -1.0, 1.0], 44, axis=0)])
    assert flagged["upside_down"] == pytest.approx(14 / 30)
    assert flagged["mirrored"] == 0


@pytest.mark.parametrize("unit", [10.0, 0.1])
def test_another_unit_is_flagged(unit: float) -> None:
    assert share_flagged([RECORDED * unit])["implausible_units"] == 1


def test_a_person_who_leaps_across_the_room_is_flagged() -> None:
    poses = RECORDED.copy()
    poses[40:] += 1.0
    assert 0 < share_flagged([poses])["implausible_pose"] < 0.5


def test_a_format_that_lacks_joints_is_judged_as_well() -> None:
    skeleton = SKELETONS["coco17"]
    frames = RECORDED[:, skeleton.carry]
    flags = []
    for poses in (frames, frames * [-1.0, 1.0, 1.0]):
        buffer = FrameBuffer(skeleton)
        for i, pose in enumerate(poses):
            buffer.push(i / 30, pose)
        outcome = buffer.look()
        assert isinstance(outcome, WindowReady)
        flags.append(outcome.flags)
    assert "mirrored" not in flags[0]
    assert "mirrored" in flags[1]


@pytest.mark.recordings
def test_real_people_are_rarely_flagged_and_mirrored_ones_nearly_always(utd_mhad: Path) -> None:
    clips = [clip.poses.astype(np.float64) for clip in load_clips(utd_mhad)[::32]]
    plain = share_flagged(clips)
    assert plain["mirrored"] == 0
    assert plain["upside_down"] == 0
    assert plain["implausible_units"] == 0
    assert plain["implausible_pose"] < 0.02  # jumps of the sensor
    some = clips[::4]
    assert share_flagged([poses * [-1.0, 1.0, 1.0] for poses in some])["mirrored"] > 0.98
    assert share_flagged([poses[:, SDK_ORDER] for poses in some])["implausible_pose"] == 1


@pytest.mark.parametrize(
    ("value", "possible"), [(0.0, True), (0.5, True), (1.0, False), (np.nan, False)]
)
def test_a_forecast_must_be_finite_and_no_faster_than_people(value: float, possible: bool) -> None:
    displacement = np.zeros((15, 20, 3), np.float32)
    displacement[3, 5, 1] = value
    fastest = measure_fastest(displacement)
    assert is_possible(fastest, rate_hz=30.0, rules=GuardRules()) == possible
