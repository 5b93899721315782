"""The robot of the client's planning example, so that both plan by the very same code."""

import importlib.util
import sys
from pathlib import Path
from typing import TYPE_CHECKING

EXAMPLE = Path(__file__).parents[2] / "clients/python/examples/point_robot.py"

if TYPE_CHECKING:
    from point_robot import STEP_S, Capsules, Constants, PointRobot, clearance_now, plan
else:
    _spec = importlib.util.spec_from_file_location("point_robot", EXAMPLE)
    _module = importlib.util.module_from_spec(_spec)
    sys.modules["point_robot"] = _module  # dataclasses look their module up
    _spec.loader.exec_module(_module)
    STEP_S, Capsules, Constants = _module.STEP_S, _module.Capsules, _module.Constants
    PointRobot, clearance_now, plan = _module.PointRobot, _module.clearance_now, _module.plan

__all__ = ["STEP_S", "Capsules", "Constants", "PointRobot", "clearance_now", "plan"]
