from itertools import islice

import numpy as np
import pytest

from models.data.clips import data_hash
from models.data.synthetic import ACTIONS, SensorNoise, SyntheticPerson, synthetic_clips
from models.skeleton import (
    HEAD,
    HIP_CENTER,
    KINECT_V1,
    LEFT_ANKLE,
    LEFT_FOOT,
    LEFT_SHOULDER,
    LEFT_WRIST,
    RIGHT_ANKLE,
    RIGHT_FOOT,
    RIGHT_SHOULDER,
    RIGHT_WRIST,
)

SEEDS = range(6)
EVERY_ACTION = pytest.mark.parametrize("action", ACTIONS)
STEP = 1 / 120
TIMES = np.arange(0, 7, STEP)


def perform(seed: int, action: str) -> np.ndarray:
    return SyntheticPerson(seed).perform([action], seconds=6.0).pose_at(TIMES)


def bone_lengths(poses: np.ndarray) -> np.ndarray:
    parent, child = np.array(KINECT_V1.bones).T
    return np.linalg.norm(poses[:, child] - poses[:, parent], axis=-1)


def speed(poses: np.ndarray) -> np.ndarray:
    return np.linalg.norm(np.diff(poses, axis=0), axis=-1) / STEP


@EVERY_ACTION
def test_bones_keep_their_lengths(action: str) -> None:
    for seed in SEEDS:
        assert np.ptp(bone_lengths(perform(seed, action)), axis=0).max() < 1e-6


@EVERY_ACTION
def test_nobody_moves_faster_than_people_do_or_jumps(action: str) -> None:
    for seed in SEEDS:
        poses = perform(seed, action)
        assert speed(poses).max() < 10.0
        assert speed(poses)[:, HIP_CENTER].max() < 2.0
        assert np.abs(np.diff(poses, 2, axis=0)).max() / STEP**2 < 400.0


@EVERY_ACTION
def test_feet_stay_on_or_above_the_floor(action: str) -> None:
    for seed in SEEDS:
        lowest = perform(seed, action)[..., 1].min() - SyntheticPerson(seed).floor
        assert -0.01 < lowest < 0.03


@EVERY_ACTION
def test_people_stay_upright(action: str) -> None:
    for seed in SEEDS:
        poses = perform(seed, action)
        assert (poses[:, HEAD, 1] > poses[:, HIP_CENTER, 1] + 0.2).all()


@EVERY_ACTION
def test_everybody_begins_and_ends_standing(action: str) -> None:
    for seed in SEEDS:
        person = SyntheticPerson(seed)
        performance = person.perform([action], seconds=6.0)
        end = performance.pose_at(np.array([0.0, 60.0]))
        height = end[:, HEAD, 1] - person.floor
        assert np.ptp(height) < 0.03
        assert speed(performance.pose_at(40 + TIMES)).max() < 0.1


def test_left_is_left_when_facing_the_sensor() -> None:
    for seed in range(30):
        person = SyntheticPerson(seed)
        pose = person.record("stand", 0.1)[0]
        assert pose[LEFT_SHOULDER, 0] < pose[RIGHT_SHOULDER, 0]
        assert pose[LEFT_ANKLE, 0] < pose[RIGHT_ANKLE, 0]
        assert 1.5 < pose[HIP_CENTER, 2] < 4.0
        toes = pose[[LEFT_FOOT, RIGHT_FOOT], 2] - pose[[LEFT_ANKLE, RIGHT_ANKLE], 2]
        assert (toes < 0).all()


def test_both_sides_of_a_body_are_alike_and_people_are_not() -> None:
    lengths = {}
    for seed in range(20):
        pose = SyntheticPerson(seed).record("stand", 0.1)[:1].astype(np.float64)
        own = dict(zip(KINECT_V1.bones, bone_lengths(pose)[0], strict=True))
        mirror = KINECT_V1.mirror
        for (a, b), length in own.items():
            assert own[(mirror[a], mirror[b])] == pytest.approx(length, abs=1e-6)
        lengths[seed] = tuple(round(length, 4) for length in own.values())
    heights = [SyntheticPerson(seed).body.height for seed in range(200)]
    assert len(set(lengths.values())) == 20
    assert min(heights) >= 1.5
    assert max(heights) <= 1.95
    assert np.std(heights) > 0.07


def test_walking_covers_ground_on_planted_feet() -> None:
    for seed in SEEDS:
        poses = perform(seed, "walk")
        path = np.linalg.norm(np.diff(poses[:, HIP_CENTER][:, [0, 2]], axis=0), axis=1).sum()
        assert path > 1.5
        floor = SyntheticPerson(seed).floor
        for foot in (LEFT_FOOT, RIGHT_FOOT):
            down = poses[1:, foot, 1] - floor < 0.01
            assert down.mean() > 0.4
            assert np.median(speed(poses)[down, foot]) < 0.05


def test_arms_swing_against_the_legs() -> None:
    poses = perform(1, "walk_in_place")
    lift = poses[:, RIGHT_ANKLE, 1] - poses[:, LEFT_ANKLE, 1]
    arms = poses[:, RIGHT_WRIST, 2] - poses[:, LEFT_WRIST, 2]  # the sensor is at smaller z
    assert np.corrcoef(lift, arms)[0, 1] > 0.1


def test_walking_in_place_and_gestures_stay_where_they_are() -> None:
    for action in ("walk_in_place", "wave", "reach", "punch", "throw", "stand"):
        ground = perform(2, action)[:, HIP_CENTER][:, [0, 2]]
        assert np.linalg.norm(ground - ground[0], axis=1).max() < 0.25


def test_a_turn_turns() -> None:
    across = perform(0, "turn")[:, RIGHT_SHOULDER] - perform(0, "turn")[:, LEFT_SHOULDER]
    heading = np.unwrap(np.arctan2(-across[:, 2], across[:, 0]))
    assert abs(heading[-1] - heading[0]) > 0.7


def test_sitting_is_low_and_squatting_comes_up_again() -> None:
    sit, squat = (perform(3, action)[:, HIP_CENTER, 1] for action in ("sit_and_work", "squat"))
    assert sit[0] - np.median(sit) > 0.25
    assert squat[0] - squat.min() > 0.2
    assert squat[0] - squat[-1] < 0.02


def test_the_favoured_hand_waves() -> None:
    for seed in range(40):
        person = SyntheticPerson(seed)
        poses = person.record("wave", 3.0)
        travel = np.linalg.norm(np.diff(poses, axis=0), axis=-1).sum(0)
        assert (travel[RIGHT_WRIST] > travel[LEFT_WRIST]) == person.style.right_handed
    assert {SyntheticPerson(seed).style.right_handed for seed in range(40)} == {True, False}


def test_the_same_seed_is_the_same_person_and_another_is_not() -> None:
    first = SyntheticPerson(7).record("reach", 2.0, noise=True)
    assert np.array_equal(first, SyntheticPerson(7).record("reach", 2.0, noise=True))
    assert not np.allclose(first, SyntheticPerson(8).record("reach", 2.0, noise=True))
    assert not np.allclose(first, SyntheticPerson(7).record("reach", 2.0, noise=True, take=1))


@pytest.mark.parametrize("rate_hz", [25.0, 60.0, 100.0])
def test_the_same_motion_can_be_sampled_at_any_rate(rate_hz: float) -> None:
    person = SyntheticPerson(4)
    for action in ("walk", "throw"):
        other = person.record(action, 4.0, rate_hz)
        whole = np.arange(4)
        assert other.shape == (round(4 * rate_hz), 20, 3)
        slow = person.perform([action], seconds=4.0).pose_at(whole.astype(np.float64))
        assert np.allclose(other[(whole * rate_hz).astype(int)], slow, atol=1e-5)


def test_it_does_not_matter_how_a_performance_is_asked() -> None:
    person, times = SyntheticPerson(9), np.arange(0, 40, 0.1)
    at_once = person.perform(seconds=3.0).pose_at(times)
    bit_by_bit = person.perform(seconds=3.0)
    backwards = np.stack([bit_by_bit.pose_at(np.array([t]))[0] for t in times[::-1]])[::-1]
    assert np.allclose(at_once, backwards, atol=1e-12)


def test_an_endless_performance_is_smooth_varied_and_stays_in_the_room() -> None:
    for seed in SEEDS:
        performance = SyntheticPerson(seed).perform(seconds=3.0)
        times = np.arange(0, 90, 1 / 60)
        poses = performance.pose_at(times)
        assert np.linalg.norm(np.diff(poses, axis=0), axis=-1).max() * 60 < 10.0
        assert len({performance.action_at(float(t)) for t in times[::30]}) >= 4
        assert np.abs(poses[:, HIP_CENTER, 0]).max() < 4.0
        assert 0.3 < poses[:, HIP_CENTER, 2].min() < poses[:, HIP_CENTER, 2].max() < 6.5


def test_a_stream_is_what_a_sensor_would_give() -> None:
    person = SyntheticPerson(11)
    frames = list(islice(person.stream(25.0), 50))
    times = np.array([time for time, _ in frames])
    poses = np.stack([pose for _, pose in frames])
    assert np.allclose(np.diff(times), 0.04)
    assert poses.dtype == np.float32
    clean = np.stack([pose for _, pose in person.stream(25.0, seconds=2.0, noise=False)])
    assert clean.shape == poses.shape
    assert 0.004 < np.std(poses - clean) < 0.02
    again = np.stack([pose for _, pose in person.stream(25.0, seconds=2.0)])
    assert np.array_equal(again, poses)


def test_a_stream_can_repeat_chosen_actions() -> None:
    person = SyntheticPerson(1)
    performance = person.perform(["wave", "squat"], seconds=2.0, endless=True)
    done = [performance.action_at(float(t)) for t in np.arange(0, 40, 0.5)]
    assert done.count("wave") > 10
    assert done.count("squat") > 10
    assert done[0] == "wave"
    frames = [pose for _, pose in person.stream(30.0, actions=["wave"], seconds=0.5)]
    assert len(frames) == 15


def test_noise_has_its_own_scale_at_the_extremities() -> None:
    noise = SensorNoise(0).sample(np.arange(0, 60, 1 / 30))
    spread = noise.std(axis=(0, 2))
    assert 0.004 < spread[HIP_CENTER] < 0.013
    assert spread[[LEFT_WRIST, RIGHT_FOOT]].mean() > 1.2 * spread[[HIP_CENTER, HEAD]].mean()


def test_clips_of_several_people_are_reproducible() -> None:
    clips = synthetic_clips(2, seed=1, actions=("wave", "walk"), takes=2, seconds=1.5)
    assert [(c.subject, c.action, c.trial) for c in clips] == [
        (person, action, take) for person in "12" for action in ("wave", "walk") for take in "12"
    ]
    assert {(c.source, c.rate_hz, c.poses.shape) for c in clips} == {("synthetic", 30, (45, 20, 3))}
    same = synthetic_clips(2, seed=1, actions=("wave", "walk"), takes=2, seconds=1.5)
    other = synthetic_clips(2, seed=2, actions=("wave", "walk"), takes=2, seconds=1.5)
    assert data_hash(clips) == data_hash(same) != data_hash(other)
    assert not np.allclose(clips[0].poses, clips[1].poses)


def test_unknown_actions_and_times_are_refused() -> None:
    with pytest.raises(ValueError, match="unknown actions \\['fly'\\]"):
        SyntheticPerson(0).record("fly", 1.0)
    with pytest.raises(ValueError, match="positive"):
        SyntheticPerson(0).perform(["wave"], seconds=0.0)
