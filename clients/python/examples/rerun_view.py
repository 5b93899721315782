"""Watch a stream in Rerun: the person, the forecast, and the truth that arrives on it.

  KEY=kc_... python rerun_view.py --user ada                    # opens the viewer
  KEY=kc_... python rerun_view.py --user ada --save stream.rrd  # writes a file instead

`person` is what the sensor sees, `forecast` where the person will be in half a second (with the
radius as balls), and `error` how far that was off once the time has come. Needs
`pip install 'kinecast-client[rerun]'`.
"""

from collections import deque
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from common import Poses, add_source, find_skeleton, make_parser, pace, read_key, read_poses, run

from kinecast_client import Client
from kinecast_client.forecasts import Forecast
from kinecast_client.interop.body import Skeleton

PERSON, FORECAST, RADIUS = (40, 40, 45), (230, 100, 15), (230, 100, 15, 25)


def find_errors(due: deque[Forecast], pose: Poses, t: float) -> list[float]:
    """Give the mean error in mm of the forecasts whose half second is over, and drop them."""
    errors = []
    while due and due[0].t[-1] <= t + 0.01:
        forecast = due.popleft()
        if abs(forecast.t[-1] - t) < 0.02:
            apart = np.linalg.norm(forecast.frames[-1] - pose, axis=-1)
            errors.append(1e3 * float(np.nanmean(apart)))
    return errors


class View:
    """Logs to Rerun.

    Args:
        rr: the module `rerun`.
        skeleton: what to draw.
        up: the user's.
    """

    def __init__(self, rr: Any, skeleton: Skeleton, up: str) -> None:
        self._rr, self._bones = rr, np.array(skeleton.bones)
        axes = {"y": "RIGHT_HAND_Y_UP", "-y": "RIGHT_HAND_Y_DOWN", "z": "RIGHT_HAND_Z_UP"}
        rr.log("scene", getattr(rr.ViewCoordinates, axes[up]), static=True)

    def show_person(self, pose: Poses, t: float) -> None:
        """Draw what was observed at a time in seconds."""
        self._rr.set_time("capture", duration=t)
        self._draw("scene/person", pose, PERSON)

    def show_forecast(self, forecast: Forecast) -> None:
        """Draw the last frame of a forecast, at the time of its newest frame."""
        self._rr.set_time("capture", duration=forecast.t_observed)
        self._draw("scene/forecast", forecast.frames[-1], FORECAST)
        if forecast.radius is not None:
            balls = self._rr.Points3D(
                forecast.frames[-1], radii=forecast.radius[-1], colors=[RADIUS]
            )
            self._rr.log("scene/forecast/radius", balls)
        self._rr.log("latency_ms", self._rr.Scalars(forecast.age_s * 1e3))

    def show_error(self, error_mm: float, t: float) -> None:
        """Plot an error at the time at which it was known."""
        self._rr.set_time("capture", duration=t)
        self._rr.log("error_mm", self._rr.Scalars(error_mm))

    def _draw(self, name: str, pose: Poses, colour: tuple[int, int, int]) -> None:
        bones = pose[self._bones]
        bones = bones[np.isfinite(bones).all(axis=(1, 2))]
        self._rr.log(name, self._rr.LineStrips3D(bones, colors=[colour], radii=0.01))


def watch(client: Client, user: str, source: Iterable[tuple[float, Poses]], view: View) -> None:
    """Send frames and log what is seen, what is foreseen, and what became of it."""
    due: deque[Forecast] = deque()
    with client.stream(user) as stream:
        for t, pose in source:
            stream.send(pose, t)
            view.show_person(pose, t)
            for error in find_errors(due, pose, t):
                view.show_error(error, t)
            forecast = stream.wait(0.02)
            if forecast is not None and forecast.is_usable:
                view.show_forecast(forecast)
                due.append(forecast)


def main(arguments: Sequence[str] | None = None) -> None:
    """Watch for as long as there are frames, or until Ctrl+C."""
    parser = make_parser(__doc__)
    add_source(parser)
    parser.add_argument("--up", default="y", choices=["y", "-y", "z"], help="the user's")
    parser.add_argument("--save", type=Path, metavar="FILE", help="write an .rrd file instead")
    options = parser.parse_args(arguments)
    try:
        import rerun as rr  # noqa: PLC0415 - large, and only this example needs it
    except ImportError:
        raise SystemExit("Rerun is missing: pip install 'kinecast-client[rerun]'") from None
    rr.init("kinecast", spawn=options.save is None)
    if options.save is not None:
        rr.save(options.save)
    with Client(options.url, read_key()) as client:
        with client.stream(options.user) as stream:
            skeleton = find_skeleton(options.url, stream.joints)
        view = View(rr, skeleton, options.up)
        watch(client, options.user, pace(read_poses(options)), view)


if __name__ == "__main__":
    run(main)
