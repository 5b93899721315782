"""The robot beside a person: what it does, and what is counted of it."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.planning.people import METHODS, SPEC, read_scenes
from benchmarks.planning.robot import (
    STEP_S,
    Capsules,
    Constants,
    PointRobot,
    plan,
)
from benchmarks.planning.rounds import PLACES, place_goals, play
from models.baselines import ZeroVelocity
from models.data.clips import Clip
from models.data.synthetic import SyntheticPerson

CONSTANTS = Constants(margin=0.15, weight=10.0)


@pytest.fixture(scope="module")
def standing():
    return SyntheticPerson(1).record("stand", 2.0)


def make_clip(poses):
    return Clip(np.asarray(poses, dtype=np.float32), "1", "1", "2", "synthetic")


def make_scene(poses):
    [scene] = read_scenes([make_clip(poses)], {"zero velocity": ZeroVelocity()})
    return scene


def sweep(poses, *, speed):
    """Let the whole person glide forward, into the robot's workspace."""
    moved = np.array(poses)
    goals = place_goals(moved[0], PLACES)
    way = goals.mean(axis=0) - moved[0, 1]
    way[1] = 0.0
    way /= np.linalg.norm(way)
    ahead = np.clip(np.arange(len(moved)) - SPEC.observe, 0, None) * STEP_S * speed
    return (moved[:1] + ahead[:, None, None] * way).astype(np.float32)


def test_clearance_is_the_distance_to_the_nearest_capsule(standing):
    pose = standing[0]
    person = Capsules.around(pose[None])
    head = pose[0] + np.array([0.0, 0.5, 0.0])
    [[found]] = person.clearance(head[None, None].astype(np.float32))
    assert found == pytest.approx(0.5 - 0.12, abs=1e-4)


def test_clearance_beside_a_bone_is_measured_across_it():
    pose = np.zeros((20, 3), dtype=np.float32)
    pose[4:8] = [[0, 0, 9], [1, 0, 9], [2, 0, 9], [3, 0, 9]]
    pose[8] = pose[4]
    point = np.array([[[0.5, 0.3, 9.0]]], dtype=np.float32)
    assert Capsules.around(pose[None]).clearance(point)[0, 0] == pytest.approx(0.25, abs=1e-5)


def test_robot_keeps_to_its_speed_and_acceleration_and_stops_at_its_target():
    robot, target = PointRobot(np.zeros(3, np.float32)), np.array([0.6, 0.0, 0.0], np.float32)
    speeds, before = [], robot.velocity
    for _ in range(60):
        robot.follow(target, CONSTANTS)
        speeds.append(float(np.linalg.norm(robot.velocity)))
        change = np.linalg.norm(robot.velocity - before) / STEP_S
        assert change <= CONSTANTS.acceleration * 1.001
        before = robot.velocity
    assert 0.9 < max(speeds) <= CONSTANTS.speed * 1.001
    assert robot.position == pytest.approx(target, abs=0.005)
    assert speeds[-1] < 0.02


def test_robot_goes_straight_for_the_goal_where_nobody_is(standing):
    person = Capsules.around(np.repeat(standing[:1], 15, axis=0))
    robot = PointRobot(np.array([20.0, 1.0, 0.0], np.float32))
    chosen = plan(robot, np.array([21.0, 1.0, 0.0], np.float32), person, CONSTANTS)
    assert chosen.manoeuvre == 0
    assert chosen.clearance > 10


def test_robot_backs_off_from_where_a_person_will_be(standing):
    goals = place_goals(standing[0], PLACES)
    robot = PointRobot(goals.mean(axis=0).astype(np.float32))
    towards = robot.position - standing[0, 1]
    steps = np.arange(1, 16)[:, None, None] / 15
    coming = Capsules.around(standing[0] + steps * towards)
    still = Capsules.around(np.repeat(standing[:1], 15, axis=0))
    chosen = plan(robot, robot.position, coming, CONSTANTS)
    assert plan(robot, robot.position, still, CONSTANTS).manoeuvre == 0
    assert (chosen.target - robot.position) @ towards > 0


def test_goals_lie_in_front_of_the_person_whatever_the_heading(standing):
    pose = standing[0]
    turned = pose @ np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]], dtype=np.float32)
    goals, others = place_goals(pose, PLACES), place_goals(turned, PLACES)
    between = np.linalg.norm(goals[:, None] - pose[None], axis=-1)
    assert np.linalg.norm(others[:, None] - turned[None], axis=-1) == pytest.approx(
        between, abs=1e-5
    )
    toes = pose[[15, 19]].mean(axis=0) - pose[[14, 18]].mean(axis=0)
    assert (goals.mean(axis=0) - pose[1]) @ toes > 0


def test_round_counts_goals_progress_and_path_of_an_undisturbed_robot(standing):
    found = play(make_scene(standing), "truth", 0, replace(CONSTANTS, margin=0.0))
    assert found.seconds == pytest.approx((len(standing) - SPEC.observe) * STEP_S)
    assert found.goals >= 1
    assert found.path_m == pytest.approx(found.progress_m, rel=0.05)
    assert found.too_close_s == 0
    assert found.closest_m > 0.1


def test_oracle_keeps_more_distance_from_a_sweep_than_zero_velocity(standing):
    scene = make_scene(sweep(standing, speed=0.8))
    blind, knowing = (
        play(scene, method, 0, replace(CONSTANTS, margin=0.2))
        for method in ("zero velocity", "truth")
    )
    assert knowing.closest_m > blind.closest_m + 0.02
    assert knowing.too_close_s <= blind.too_close_s


def test_oracle_sees_what_happens_and_holds_the_last_pose(standing):
    scene = make_scene(standing)
    truth = scene.forecasts["truth"]
    assert truth.shape == (len(scene.truth) - 1, SPEC.horizon, 20, 3)
    np.testing.assert_array_equal(truth[3, :5], scene.truth[4:9])
    np.testing.assert_array_equal(truth[-1], np.repeat(scene.truth[-1:], SPEC.horizon, axis=0))


def test_forecasts_start_from_frames_that_were_seen(standing):
    scene = make_scene(standing)
    held = scene.forecasts["zero velocity"]
    assert len(held) == len(scene.truth) - 1
    np.testing.assert_array_equal(held[7, 0], scene.truth[7])
    assert set(scene.forecasts) <= set(METHODS)
