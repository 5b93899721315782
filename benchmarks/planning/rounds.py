"""One round: the robot works beside one recorded person for as long as the clip lasts."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Float32

from benchmarks.planning.people import Scene
from benchmarks.planning.robot import STEP_S, Capsules, Constants, PointRobot, clearance_now, plan
from models.skeleton import (
    LEFT_HIP,
    LEFT_SHOULDER,
    RIGHT_HIP,
    RIGHT_SHOULDER,
    SHOULDER_CENTER,
)

THRESHOLD_M = 0.10
"""Closer than this is too close: what a round counts, whatever margin the planner keeps."""
PLACES = ((-0.40, -0.35, 0.35), (0.40, 0.05, 0.35), (-0.40, 0.05, 0.35), (0.40, -0.35, 0.35))
"""Where the goals are, seen from between the person's shoulders: to the left, up, ahead; metres."""
TASKS = (PLACES, PLACES[1:] + PLACES[:1])
"""Where the robot starts, and where it goes then, over and over."""


@dataclass(frozen=True)
class Round:
    """What became of a round.

    Attributes:
        seconds: how long it was.
        closest_m: the least distance between the surfaces of robot and person; below 0 a collision.
        too_close_s: seconds with less than `THRESHOLD_M`.
        goals: how many were reached.
        progress_m: how far the robot came along the straight lines between the goals.
        path_m: how far it moved.
        changes: how often it changed its plan.
    """

    seconds: float
    closest_m: float
    too_close_s: float
    goals: int
    progress_m: float
    path_m: float
    changes: int

    def as_json(self) -> dict[str, Any]:
        """Give it as JSON can hold it."""
        return asdict(self)


def play(scene: Scene, method: str, task: int, constants: Constants) -> Round:
    """Let the robot work beside the person, who does what was recorded, whatever the robot does.

    At each frame the robot plans against what the method forecasts from this frame on and moves
    until the next one; the distance is that to where the person then is.
    """
    goals = place_goals(scene.truth[0], TASKS[task])
    robot, path, aim, changes = PointRobot(goals[0].copy()), [goals[0]], 1, 0
    clearances, before = [], None
    for forecast, pose in zip(scene.forecasts[method], scene.truth[1:], strict=True):
        goal = goals[aim % len(goals)]
        chosen = plan(robot, goal, Capsules.around(forecast), constants)
        changes += before is not None and before != chosen.manoeuvre
        robot.follow(chosen.target, constants)
        path.append(robot.position)
        clearances.append(clearance_now(robot, pose, constants))
        reached = bool(np.linalg.norm(robot.position - goal) < constants.reached)
        aim, before = aim + reached, None if reached else chosen.manoeuvre
    return Round(
        seconds=len(clearances) * STEP_S,
        closest_m=min(clearances),
        too_close_s=sum(gap < THRESHOLD_M for gap in clearances) * STEP_S,
        goals=aim - 1,
        progress_m=_measure_progress(goals, aim, robot.position),
        path_m=float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum()),
        changes=changes,
    )


def place_goals(
    pose: Float32[np.ndarray, "joint 3"], places: Sequence[tuple[float, float, float]]
) -> Float32[np.ndarray, "goal 3"]:
    """Put the goals in front of a person: metres, y up, in the frame of the pose."""
    left = pose[LEFT_SHOULDER] - pose[RIGHT_SHOULDER] + pose[LEFT_HIP] - pose[RIGHT_HIP]
    left[1] = 0.0
    left /= np.linalg.norm(left)
    up = np.array([0.0, 1.0, 0.0], dtype=np.float32)
    axes = np.stack([left, up, np.cross(left, up)]).astype(np.float32)
    return np.asarray(pose[SHOULDER_CENTER] + np.asarray(places, dtype=np.float32) @ axes)


def _measure_progress(goals: np.ndarray, aim: int, position: np.ndarray) -> float:
    """Add up the legs that were finished, and what was gained on the last one."""
    legs = [float(np.linalg.norm(goals[k % 4] - goals[(k - 1) % 4])) for k in range(1, aim + 1)]
    left = float(np.linalg.norm(goals[aim % 4] - position))
    return sum(legs) - left
