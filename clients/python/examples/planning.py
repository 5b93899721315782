"""A robot that keeps its distance, live: the loop of the comparison in docs/planning.md.

Each frame goes to the service; the robot plans against the newest forecast that may be used, and
against the person standing still where there is none. It prints how near it came.

  KEY=kc_... python planning.py --user ada             # a waving person
  KEY=kc_... python planning.py --user ada --blind     # the same without forecasts

The user has the skeleton `kinect_v1` and `up` "y". This is a planner for a demonstration; it is not
a safety function, and neither is a forecast.
"""

import argparse
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from common import Poses, add_source, make_parser, pace, read_key, read_poses, run
from numpy.typing import NDArray
from point_robot import Capsules, Constants, PointRobot, clearance_now, plan

from kinecast_client import Client
from kinecast_client.forecasts import Forecast

HORIZON = 15
PLACES = np.array([(-0.45, 0.0, 0.35), (0.45, 0.0, 0.35)])
"""Where the robot goes to and fro, from between the shoulders: to the left, up, ahead; metres."""
STEP_S = 1 / 30


class Stream(Protocol):
    """What the loop needs of a stream."""

    def send(self, joints: NDArray[np.floating] | None, t: float | None = None) -> int | None:
        """Send a frame."""
        ...

    def wait(self, timeout_s: float) -> Forecast | None:
        """Wait for a forecast that was not given yet."""
        ...

    def latest(self) -> Forecast | None:
        """Give the newest forecast that may be used."""
        ...


@dataclass(frozen=True)
class Outcome:
    """What became of a run.

    Attributes:
        goals: how many were reached.
        closest_m: the least distance between the surfaces of robot and person.
        foreseen: the share of the frames that had a forecast.
    """

    goals: int
    closest_m: float
    foreseen: float


def place_goals(pose: Poses) -> NDArray[np.float32]:
    """Put the goals in front of the person, y up, left and right of the middle."""
    left = (pose[4] - pose[8]) * [1, 0, 1]
    left /= np.linalg.norm(left)
    ahead = np.cross(left, [0, 1, 0])
    return np.asarray(pose[1] + PLACES @ np.stack([left, [0, 1, 0], ahead]), dtype=np.float32)


def expect(forecast: Forecast | None, pose: Poses, now: float) -> Capsules:
    """Give where the person is to be expected in the next half second: as capsules per step.

    What of a forecast lies in the past by now is left out, and its last pose held instead.
    """
    if forecast is None or not forecast.is_usable:
        return Capsules.around(np.repeat(pose[None], HORIZON, axis=0))
    steps = np.searchsorted(forecast.t, now + STEP_S * np.arange(1, HORIZON + 1) - STEP_S / 2)
    return Capsules.around(forecast.frames[np.minimum(steps, HORIZON - 1)])


def work(
    source: Iterable[tuple[float, Poses]], stream: Stream | None, constants: Constants
) -> Outcome:
    """Go to and fro in front of the person for as long as there are frames.

    Args:
        source: poses with their times.
        stream: where forecasts come from; None for none.
        constants: of robot and planner.
    """
    robot, goals, reached, foreseen, gaps = None, None, 0, 0, []
    for t, pose in source:
        if robot is None or goals is None:
            goals = place_goals(pose)
            robot = PointRobot(goals[0].copy())
        gaps.append(clearance_now(robot, np.asarray(pose, dtype=np.float32), constants))
        forecast = None
        if stream is not None:
            stream.send(pose, t)
            forecast = stream.wait(0.01) or stream.latest()
        foreseen += forecast is not None
        goal = goals[(reached + 1) % len(goals)]
        robot.follow(plan(robot, goal, expect(forecast, pose, t), constants).target, constants)
        reached += bool(np.linalg.norm(robot.position - goal) < constants.reached)
    return Outcome(reached, min(gaps, default=float("inf")), foreseen / max(1, len(gaps)))


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Read the command line."""
    parser = make_parser(__doc__)
    add_source(parser)
    parser.add_argument("--margin", type=float, default=0.2, help="metres to be kept")
    parser.add_argument("--blind", action="store_true", help="take the person as standing still")
    return parser.parse_args(arguments)


def main(arguments: Sequence[str] | None = None) -> None:
    """Work beside the person, and say what became of it."""
    options = parse(arguments)
    constants, source = Constants(margin=options.margin), pace(read_poses(options))
    if options.blind:
        found = work(source, None, constants)
    else:
        with Client(options.url, read_key()) as client, client.stream(options.user) as stream:
            found = work(source, stream, constants)
    print(
        f"{found.goals} goals, closest {100 * found.closest_m:.1f} cm, "
        f"forecasts for {found.foreseen:.0%} of the frames"
    )


if __name__ == "__main__":
    run(main)
