"""Parts of the examples that need no server."""

import sys
from collections import deque
from types import SimpleNamespace

import numpy as np
import pytest
from kinecast_client.interop.body import KINECT_V1
from kinecast_client.samples import waving_person

from tests.unit.clients.examples import load_example
from tests.unit.clients.robots import make_forecast

planning, rerun_view, robots = map(load_example, ("planning", "rerun_view", "point_robot"))
POSE = waving_person(1.0)[0]


class FakeRerun:
    """Keeps what is logged, in the place of the module."""

    ViewCoordinates = SimpleNamespace(RIGHT_HAND_Y_UP="y up")

    def __init__(self):
        self.logged, self.time = [], None

    def set_time(self, timeline, *, duration):
        self.time = duration

    def log(self, name, what, *, static=False):
        self.logged.append((name, what, None if static else self.time))

    def LineStrips3D(self, strips, **style):  # noqa: N802 - Rerun's name
        return np.asarray(strips)

    def Points3D(self, points, *, radii, colors):  # noqa: N802
        return np.asarray(radii)

    def Scalars(self, value):  # noqa: N802
        return value


def test_robot_expects_the_person_where_the_forecast_says_from_now_on():
    frames = np.repeat(POSE[None], 15, axis=0) + np.arange(15)[:, None, None] * 0.1
    forecast = make_forecast(frames.astype(np.float32), t=100.0)
    expected = planning.expect(forecast, POSE, 100.0 + 3 / 30)
    heads = expected.start[:, 0, 0] - POSE[0, 0]
    assert heads == pytest.approx([*np.arange(3, 15) * 0.1, *[1.4] * 3], abs=1e-4)


@pytest.mark.parametrize("forecast", [None, make_forecast(severity="unsafe")])
def test_robot_without_a_usable_forecast_takes_the_person_as_standing(forecast):
    expected = planning.expect(forecast, POSE, 0.0)
    assert len(expected.start) == planning.HORIZON
    assert (expected.start == expected.start[:1]).all()


def test_live_goals_lie_before_the_person_on_either_side():
    goals = planning.place_goals(POSE) - POSE[1]
    assert goals[:, 2] == pytest.approx([-0.35] * 2, abs=0.05)  # the sensor is before the person
    assert goals[0, 0] == pytest.approx(-goals[1, 0], abs=0.05)


def test_error_is_known_when_the_time_of_the_forecast_has_come():
    forecast = make_forecast(np.repeat(POSE[None], 15, axis=0).astype(np.float32), t=10.0)
    due = deque([forecast])
    assert rerun_view.find_errors(due, POSE, 10.4) == []
    shifted = POSE + np.array([0.03, 0.0, 0.0])
    assert rerun_view.find_errors(due, shifted, 10.5) == [pytest.approx(30.0, abs=0.01)]
    assert not due


def test_forecast_whose_time_no_frame_met_has_no_error():
    due = deque([make_forecast(t=10.0)])
    assert rerun_view.find_errors(due, POSE, 10.6) == []
    assert not due


def test_rerun_is_told_of_person_forecast_radius_and_error():
    rerun = FakeRerun()
    view = rerun_view.View(rerun, KINECT_V1, "y")
    pose = POSE.copy()
    pose[11] = np.nan
    view.show_person(pose, 9.5)
    view.show_forecast(make_forecast(t=9.6))
    view.show_error(12.0, 9.7)
    told = {name: (what, at) for name, what, at in rerun.logged}
    assert told["scene"] == ("y up", None)
    assert len(told["scene/person"][0]) == len(KINECT_V1.bones) - 1
    assert told["scene/person"][1] == 9.5
    assert told["scene/forecast/radius"][0] == pytest.approx([0.07] * 20)
    assert told["scene/forecast"][1] == 9.6
    assert told["error_mm"] == (12.0, 9.7)


def test_missing_rerun_is_explained(monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(SystemExit, match="pip install"):
        rerun_view.main([])
