"""A point robot that must reach goals and keep its distance from a person: world and planner.

It stands for the tool of a light arm that works where a person works as well. Thirty times a second
it looks half a second ahead: it tries some sixty short manoeuvres against the capsules in which the
person is expected, and takes the best one. Nothing here asks where the forecast comes from, so
that forecasts can be compared: see planning.py beside this file, and `make planning`.

This is a planner for a comparison. It is not a safety function, and neither is a forecast.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import product

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]

STEP_S = 1 / 30
BONES: tuple[tuple[int, int, float], ...] = (
    (0, 0, 0.12),  # head
    (0, 1, 0.07),  # neck
    (1, 2, 0.14),
    (2, 3, 0.14),
    (4, 8, 0.08),  # shoulders
    (12, 16, 0.12),  # hips
    *((a, b, 0.05) for a, b in ((4, 5), (8, 9))),
    *((a, b, 0.04) for a, b in ((5, 6), (6, 7), (9, 10), (10, 11))),
    *((a, b, 0.08) for a, b in ((12, 13), (16, 17))),
    *((a, b, 0.06) for a, b in ((13, 14), (17, 18), (14, 15), (18, 19))),
)
"""Two joints of kinect_v1 and a radius in metres: the person's body as capsules."""


@dataclass(frozen=True)
class Constants:
    """Everything about the robot and its planner; the same for every forecast.

    Attributes:
        speed: metres per second at most.
        acceleration: metres per second squared at most.
        size: radius of the robot in metres.
        reached: a goal counts as reached within this distance, in metres.
        margin: the distance from the person that the planner wants to keep, in metres.
        weight: what a metre too close costs, in metres of distance to the goal.
        reach: how far away manoeuvres lead, in metres.
        lead: after how many steps a manoeuvre turns to the goal.
    """

    speed: float = 1.0
    acceleration: float = 8.0
    size: float = 0.05
    reached: float = 0.05
    margin: float = 0.2
    weight: float = 30.0
    reach: tuple[float, ...] = (0.12, 0.35)
    lead: tuple[int, ...] = (6, 15)


@dataclass(frozen=True, eq=False)
class Capsules:
    """A person at some moments, as capsules.

    Attributes:
        start: one end, metres: [moment, bone, 3].
        along: from there to the other end: [moment, bone, 3].
        radius: metres: [bone].
    """

    start: Array
    along: Array
    radius: Array

    @classmethod
    def around(cls, poses: NDArray[np.floating]) -> "Capsules":
        """Put capsules around poses of kinect_v1: [moment, joint, 3] in metres."""
        ends = np.array([bone[:2] for bone in BONES])
        radius = np.array([bone[2] for bone in BONES], dtype=np.float32)
        start = np.asarray(poses[:, ends[:, 0]], dtype=np.float32)
        return cls(start, np.asarray(poses[:, ends[:, 1]], dtype=np.float32) - start, radius)

    def clearance(self, points: Array) -> Array:
        """Give the distance from points to the nearest skin, below 0 inside.

        Args:
            points: metres, as many moments as the person has: [moment, point, 3].

        Returns:
            Metres: [moment, point].
        """
        here = points[:, :1]  # near it, so that squares stay small
        points, start = points - here, self.start - here
        length = np.maximum(np.square(self.along).sum(axis=-1), 1e-9)
        across = _dot(points, self.along) - (start * self.along).sum(axis=-1)[:, None]
        share = np.clip(across / length[:, None], 0.0, 1.0)
        square = np.square(points).sum(axis=-1)[..., None] - 2 * _dot(points, start)
        square += np.square(start).sum(axis=-1)[:, None]
        square += share * (share * length[:, None] - 2 * across)
        gap = np.sqrt(np.maximum(square, 0.0)) - self.radius
        return np.asarray(gap.min(axis=-1), dtype=np.float32)


@dataclass
class PointRobot:
    """Where the robot is and how fast; metres and metres per second, in the person's frame."""

    position: Array
    velocity: Array = field(default_factory=lambda: np.zeros(3, dtype=np.float32))

    def follow(self, target: Array, constants: Constants) -> None:
        """Move for one step towards a target, as fast as the constants allow."""
        self.position, self.velocity = step(self.position, self.velocity, target, constants)


@dataclass(frozen=True)
class Plan:
    """What the robot is about to do.

    Attributes:
        target: where it heads now, metres.
        manoeuvre: which of those tried; 0 goes straight for the goal.
        clearance: the least that it expects within its look-ahead, metres.
    """

    target: Array
    manoeuvre: int
    clearance: float


def step(
    position: Array, velocity: Array, target: Array, constants: Constants
) -> tuple[Array, Array]:
    """Give position and velocity after one step of heading for a target: [..., 3] each.

    The robot slows down in time to stop at the target.
    """
    away = target - position
    distance = np.sqrt(np.square(away).sum(axis=-1, keepdims=True)) + 1e-9
    brakes = np.sqrt(2 * 0.7 * constants.acceleration * distance)
    wanted = away / distance * np.minimum(np.minimum(constants.speed, brakes), distance / STEP_S)
    change = wanted - velocity
    size = np.sqrt(np.square(change).sum(axis=-1, keepdims=True)) + 1e-9
    change = change * np.minimum(1.0, constants.acceleration * STEP_S / size)
    velocity = (velocity + change).astype(np.float32)
    return (position + velocity * np.float32(STEP_S)).astype(np.float32), velocity


def plan(robot: PointRobot, goal: Array, person: Capsules, constants: Constants) -> Plan:
    """Choose what to do next, looking as many steps ahead as the person is foreseen.

    Args:
        robot: where it is.
        goal: where it should go, metres: [3].
        person: where the person is expected after 1, 2, … steps.
        constants: of robot and planner.
    """
    targets, lead = _propose(robot.position, goal, constants)
    paths = _roll_out(robot, targets, lead, goal, len(person.start), constants)
    clearance = person.clearance(paths) - constants.size
    distance = np.sqrt(np.square(paths - goal).sum(axis=-1))
    too_close = np.maximum(constants.margin - clearance, 0.0)
    cost = distance.mean(axis=0) + constants.weight * too_close.mean(axis=0)
    best = int(cost.argmin())
    return Plan(targets[best], best, float(clearance[:, best].min()))


def clearance_now(robot: PointRobot, pose: Array, constants: Constants) -> float:
    """Give the distance between the robot's and the person's surface, in metres."""
    person = Capsules.around(pose[None])
    return float(person.clearance(robot.position[None, None])[0, 0]) - constants.size


def _propose(position: Array, goal: Array, constants: Constants) -> tuple[Array, NDArray[np.int64]]:
    """Give targets [manoeuvre, 3], the goal first, and after how many steps each is left for it."""
    around = [position + reach * _WAYS for reach in constants.reach]
    detours = np.concatenate([position[None], *around])
    targets = np.concatenate([goal[None], *([detours] * len(constants.lead))])
    lead = np.concatenate([[0], np.repeat(constants.lead, len(detours))])
    return targets.astype(np.float32), lead


def _roll_out(
    robot: PointRobot,
    targets: Array,
    lead: NDArray[np.int64],
    goal: Array,
    steps: int,
    constants: Constants,
) -> Array:
    """Give the positions of every manoeuvre after each step: [step, manoeuvre, 3]."""
    position = np.repeat(robot.position[None], len(targets), axis=0)
    velocity = np.repeat(robot.velocity[None], len(targets), axis=0)
    path = np.empty((steps, len(targets), 3), dtype=np.float32)
    for k in range(steps):
        heads_for = np.where((k < lead)[:, None], targets, goal)
        position, velocity = step(position, velocity, heads_for, constants)
        path[k] = position
    return path


def _dot(points: Array, others: Array) -> Array:
    """Give the products of each moment's points and others: [moment, point, other]."""
    return np.asarray(points @ others.transpose(0, 2, 1), dtype=np.float32)


def _unit_ways(steps: Iterable[tuple[int, ...]]) -> Array:
    ways = np.array([way for way in steps if any(way)], dtype=np.float32)
    return np.asarray(ways / np.linalg.norm(ways, axis=1, keepdims=True), dtype=np.float32)


_WAYS = _unit_ways(way for way in product((-1, 0, 1), repeat=3) if sum(map(abs, way)) != 2)
"""The directions to the faces and the corners of a cube: 14."""
