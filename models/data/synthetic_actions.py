"""What synthetic people do with their hands and trunk: gestures between key poses.

Between two key poses every control moves by minimum jerk (Flash and Hogan, The coordination of arm
movements, J. Neuroscience 5, 1985). A gesture begins and ends standing, so anything can follow.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from models.data.synthetic_body import Control
from models.data.synthetic_gait import GAITS, Style, minimum_jerk, stand_pose


@dataclass(frozen=True, eq=False)
class Gesture:
    """Key poses in time; between two of them each control moves by minimum jerk."""

    times: Float64[np.ndarray, " key"]
    poses: Float64[np.ndarray, "key control"]

    @property
    def seconds(self) -> float:
        """Until the last key pose."""
        return float(self.times[-1])

    def controls(self, t: Float64[np.ndarray, " time"]) -> Float64[np.ndarray, "time control"]:
        """Give the controls at some times; the first and last pose are held outside."""
        key = np.clip(np.searchsorted(self.times, t, side="right") - 1, 0, len(self.times) - 2)
        share = (t - self.times[key]) / (self.times[key + 1] - self.times[key])
        start, end = self.poses[key], self.poses[key + 1]
        return np.asarray(start + (end - start) * minimum_jerk(share)[:, None])


class _Script:
    """Writes a gesture key by key, in terms of the hand that leads and the other one."""

    def __init__(self, style: Style, random: np.random.Generator) -> None:
        self.style, self.random = style, random
        self.rest = stand_pose(style)
        self.times, self.poses = [0.0], [self.rest]
        self.leading = style.right_handed

    def key(
        self,
        seconds: float,
        *,
        lead: tuple[float, float, float] | None = None,
        other: tuple[float, float, float] | None = None,
        twist: float = 0.0,
        **controls: float,
    ) -> None:
        """Go to a pose: hands as (out, up, forward); twist towards the leading side."""
        pose, first = self.rest.copy(), Control.RIGHT_OUT if self.leading else Control.LEFT_OUT
        second = Control.LEFT_OUT if self.leading else Control.RIGHT_OUT
        for start, hand in ((first, lead), (second, other)):
            if hand is not None:
                pose[start : start + 3] = hand
        pose[Control.TWIST] = -twist if self.leading else twist
        for name, value in controls.items():
            pose[Control[name.upper()]] += value
        self.pause(seconds, pose)

    def pause(self, seconds: float, pose: Float64[np.ndarray, " control"] | None = None) -> None:
        """Hold the pose, or go to one as it is."""
        self.times.append(self.times[-1] + seconds / self.style.tempo)
        self.poses.append(self.poses[-1] if pose is None else pose)

    def vary(self, low: float, high: float) -> float:
        """Draw a number."""
        return float(self.random.uniform(low, high))

    def happens(self, chance: float) -> bool:
        """Throw a coin that falls so often on the right side."""
        return self.vary(0.0, 1.0) < chance

    def count(self, low: int, high: int) -> int:
        """Draw a number of repetitions, `high` not included."""
        return int(self.random.integers(low, high))

    @property
    def full(self) -> float:
        """Seconds so far."""
        return self.times[-1]

    def finish(self) -> Gesture:
        """Give the gesture as written."""
        return Gesture(times=np.array(self.times), poses=np.stack(self.poses))


def _reach(script: _Script) -> None:
    size = script.style.amplitude
    script.leading = script.style.right_handed == script.happens(0.8)
    out, up = script.vary(-0.25, 0.45), script.vary(-0.35, 0.55)
    forward = np.sqrt(max(0.2, (0.86 * min(size, 1.08)) ** 2 - out**2 - up**2))
    spot = (out, up, float(forward))
    low = max(0.0, -up)
    script.key(
        script.vary(0.7, 1.0), lead=spot, twist=-0.25, lean=0.08 + 0.35 * low, nod=0.1 + 0.3 * low
    )
    script.pause(script.vary(0.15, 0.4))
    if script.happens(0.5):
        carried = (script.vary(-0.1, 0.3), script.vary(-0.3, 0.1), 0.45)
        script.key(0.7, lead=carried, lean=0.05, nod=0.2)
    script.key(script.vary(0.7, 1.0))


def _wave(script: _Script) -> None:
    size, rate = script.style.amplitude, script.vary(0.22, 0.3)
    up, width = script.vary(0.15, 0.45), script.vary(0.16, 0.26) * size
    script.key(0.75, lead=(0.40 + width / 2, up, 0.35), bend=-0.03)
    for beat in range(script.count(5, 10)):
        side = width if beat % 2 else -width
        script.key(rate, lead=(0.40 + side, up + 0.03 * (beat % 2), 0.35), bend=-0.03)
    script.key(0.8)


def _punch(script: _Script) -> None:
    guard = (-0.12, -0.02, 0.42)
    stance = {"drop": 0.03, "lean": 0.08}
    script.key(0.6, lead=guard, other=guard, **stance)
    for _ in range(script.count(2, 5)):
        blow = (script.vary(-0.25, 0.0), script.vary(-0.05, 0.15), 0.93)
        script.key(script.vary(0.22, 0.3), lead=blow, other=guard, twist=-0.5, **stance)
        script.key(0.32, lead=guard, other=guard, **stance)
        script.leading = not script.leading
    script.leading = script.style.right_handed
    script.key(0.7)


def _squat(script: _Script) -> None:
    depth = script.vary(0.3, 0.45) * min(script.style.amplitude, 1.1)
    arms = (0.05, script.vary(-0.15, 0.05), 0.9)
    down = {"drop": depth, "back": depth * 0.35, "lean": depth * 1.3, "nod": -depth * 0.5}
    for _ in range(script.count(1, 4)):
        script.key(script.vary(0.85, 1.2), lead=arms, other=arms, **down)
        script.pause(script.vary(0.1, 0.4))
        script.key(script.vary(0.8, 1.1))


def _throw(script: _Script) -> None:
    size = script.style.amplitude
    script.key(0.45, lead=(-0.1, -0.15, 0.5), other=(-0.1, -0.15, 0.5), twist=0.1)
    script.key(
        0.5,
        lead=(0.5 * size, 0.3, -0.25),
        other=(0.1, -0.2, 0.75),
        twist=0.6,
        lean=-0.08,
        back=0.04,
    )
    script.key(0.34, lead=(0.05, 0.35, 0.85), other=(0.3, -0.6, 0.3), twist=-0.25, lean=0.12)
    script.key(0.35, lead=(-0.35, -0.5, 0.55), twist=-0.5, lean=0.3, drop=0.03, nod=-0.1)
    script.key(0.8)


def _sit_and_work(script: _Script, seconds: float) -> None:
    down = {"drop": script.vary(0.42, 0.47), "back": 0.48}
    desk = (script.vary(-0.05, 0.1), -0.42, 0.5)
    script.key(
        0.7, lean=0.5, drop=0.15, back=0.2, lead=(0.1, -0.75, 0.45), other=(0.1, -0.75, 0.45)
    )
    script.key(0.7, lead=desk, other=desk, lean=0.08, **down)
    while script.full < max(seconds - 2.2, 3.0):
        script.leading = script.style.right_handed == script.happens(0.7)
        spot = (script.vary(-0.35, 0.45), script.vary(-0.45, -0.15), script.vary(0.45, 0.8))
        near = (script.vary(-0.25, 0.05), script.vary(-0.45, -0.3), script.vary(0.4, 0.55))
        lean = 0.08 + 0.25 * max(0.0, spot[2] - 0.5)
        script.key(script.vary(0.5, 1.0), lead=spot, other=desk, lean=lean, nod=0.3, **down)
        script.pause(script.vary(0.1, 0.6))
        script.key(script.vary(0.5, 1.0), lead=near, other=desk, lean=0.1, nod=0.35, **down)
        script.pause(script.vary(0.0, 0.5) + 0.05)
    script.key(0.6, lean=0.5, drop=0.35, back=0.4, lead=(0.1, -0.7, 0.5), other=(0.1, -0.7, 0.5))
    script.key(0.8)


_GESTURES: dict[str, Callable[[_Script], None]] = {
    "punch": _punch,
    "reach": _reach,
    "squat": _squat,
    "throw": _throw,
    "wave": _wave,
}
ACTIONS = tuple(sorted((*_GESTURES, *GAITS, "sit_and_work", "stand")))
"""Everything that synthetic people can do."""


def write_gesture(
    action: str, *, style: Style, seconds: float, random: np.random.Generator
) -> Gesture:
    """Write a gesture that lasts at least some seconds, done as often as fits."""
    script = _Script(style, random)
    if action == "sit_and_work":
        _sit_and_work(script, seconds)
    while action in _GESTURES and script.full < seconds:
        script.leading = style.right_handed
        _GESTURES[action](script)
        script.pause(script.vary(0.1, 0.5))
    if script.full < seconds or len(script.times) < 2:
        script.pause(max(seconds - script.full, 0.1) * style.tempo, script.rest)
    return script.finish()
