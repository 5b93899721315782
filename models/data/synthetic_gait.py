"""How synthetic people stand and step: gaits driven by a phase, with feet that stay planted.

Every foot is put down where the body will be in the middle of its stance, and left there. A gait
begins and ends standing, so that anything can follow it.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from models.data.synthetic_body import CONTROLS, Body, Control, Feet, yaw

GAITS = ("turn", "walk", "walk_in_place")
_STANCE = 0.6
"""Share of a stride for which a foot is on the floor."""
_LATER = np.array((0.0, 0.5))
"""By how much of a stride the right and the left foot are ahead."""
_START = 0.5
"""Strides in which a body gets going, and stops."""
_CLOSING = 1.2
"""Strides from when the body begins to stop until the last foot is beside the other."""
_MIDDLE = np.array((0.0, 0.0, 2.8))
_ROOM_RADIUS_M = 1.5


@dataclass(frozen=True, slots=True)
class Style:
    """How a person moves.

    Attributes:
        tempo: of everything; 1 is average.
        amplitude: of gestures; 1 is average.
        stoop: lean of the trunk when standing, radians.
        right_handed: which hand does things.
        arm_carriage: how far the arms hang from the body, in arm lengths.
        elbow: how much shorter a hanging arm is than a straight one.
        stride: in leg lengths.
        cadence_hz: strides per second.
        liveliness: how much a standing person sways.
    """

    tempo: float
    amplitude: float
    stoop: float
    right_handed: bool
    arm_carriage: float
    elbow: float
    stride: float
    cadence_hz: float
    liveliness: float


@dataclass(frozen=True, slots=True)
class Stand:
    """Where somebody stands: metres on the floor; heading in radians, 0 faces the sensor."""

    x: float
    z: float
    heading: float


@dataclass(frozen=True, slots=True)
class Gait:
    """Steps along an arc, on the spot, or turning on the spot.

    Attributes:
        strides: whole strides from rest to rest, at least 3.
        cadence_hz: strides per second.
        length: metres per stride; 0 stays on the spot.
        turn: radians to the left per stride.
        lift: metres that an ankle is lifted.
        swing: radians that the arms swing.
    """

    strides: int
    cadence_hz: float
    length: float
    turn: float
    lift: float
    swing: float

    @property
    def seconds(self) -> float:
        """From rest to rest."""
        return self.strides / self.cadence_hz

    def activity(self, phase: Float64[np.ndarray, "*any"]) -> Float64[np.ndarray, "*any"]:
        """From 0 at rest to 1 in full stride, by phase in strides."""
        return np.asarray(
            minimum_jerk(phase / _START) - minimum_jerk((phase - self._brake) / _START)
        )

    def progress(self, phase: Float64[np.ndarray, "*any"]) -> Float64[np.ndarray, "*any"]:
        """Strides covered by the body: the integral of activity."""
        return np.asarray(
            _START * _integrated_jerk(phase / _START)
            - _START * _integrated_jerk((phase - self._brake) / _START)
        )

    def follow(
        self, start: Stand, covered: Float64[np.ndarray, "*any"]
    ) -> tuple[Float64[np.ndarray, "*any 3"], Float64[np.ndarray, "*any"]]:
        """Place on the floor and heading after some strides."""
        heading = start.heading + self.turn * covered
        if self.turn and self.length:
            radius = self.length / self.turn
            x = start.x + radius * (np.cos(heading) - np.cos(start.heading))
            z = start.z - radius * (np.sin(heading) - np.sin(start.heading))
        else:
            x = start.x - self.length * covered * np.sin(heading)
            z = start.z - self.length * covered * np.cos(heading)
        return np.stack((x, np.zeros_like(x), z), axis=-1), heading

    def end(self, start: Stand) -> Stand:
        """Where it leads from `start`."""
        place, heading = self.follow(start, self.progress(np.array([float(self.strides)])))
        return Stand(float(place[0, 0]), float(place[0, 2]), float(heading[0]))

    def feet(self, start: Stand, phase: Float64[np.ndarray, " time"], body: Body) -> Feet:
        """Planted in stance, on their way to the next place in swing; left half a stride later."""
        own = phase[:, None] + _LATER
        step, share = np.floor(own), own - np.floor(own)
        middle = step - _LATER + _STANCE / 2
        swing = np.clip((share - _STANCE) / (1.0 - _STANCE), 0.0, 1.0)
        before, here, there = (self.progress(middle + ahead) for ahead in (-1.0, 0.0, 1.0))
        covered = here + (there - here) * (0.5 - 0.5 * np.cos(np.pi * swing))
        place, heading = self.follow(start, covered)
        place = place + _sideways(heading, body.half_stance)
        last, coming = np.minimum(1.0, 1.5 * (here - before)), np.minimum(1.0, 1.5 * (there - here))
        place[..., 1] = self.lift * coming * np.sin(np.pi * swing) ** 2
        heel = minimum_jerk((share - 0.42) / (_STANCE - 0.42)) - minimum_jerk(swing * 1.6)
        toes = coming * minimum_jerk((swing - 0.55) / 0.4)
        toes = np.where(share < _STANCE, last * (1.0 - minimum_jerk(share / 0.12)), toes)
        pitch = (0.5 * coming * heel - 0.2 * toes) * min(1.0, self.length / 0.6)
        return Feet(position=place, heading=heading, pitch=pitch)

    def sway(
        self, phase: Float64[np.ndarray, " time"], *, body: Body, style: Style
    ) -> Float64[np.ndarray, "time control"]:
        """Move the rest of the body with the steps; to be added to standing."""
        moves = np.zeros((len(phase), CONTROLS))
        active, turn = self.activity(phase), 2.0 * np.pi * phase
        reach = min(0.5 * _STANCE * self.length / body.leg, 0.5)
        dip = 1.0 - np.sqrt(1.0 - reach**2)
        moves[:, Control.DROP] = active * dip * (0.62 + 0.5 * np.cos(2.0 * turn - 0.2 * np.pi))
        moves[:, Control.SIDE] = active * 0.028 * np.cos(turn - 0.6 * np.pi)
        moves[:, Control.LEAN] = active * 0.06 * min(1.0, self.length)
        moves[:, Control.TWIST] = active * 0.35 * self.swing * np.cos(turn)
        moves[:, Control.BEND] = active * 0.02 * np.cos(turn - 0.6 * np.pi)
        for first, sign in ((Control.RIGHT_OUT, -1.0), (Control.LEFT_OUT, 1.0)):
            angle = active * self.swing * (sign * np.cos(turn) + 0.15)
            bent = active * 0.10 * self.swing * (1.0 + sign * np.cos(turn))
            length = 1.0 - style.elbow - bent
            moves[:, first + 1] = (1.0 - style.elbow) - length * np.cos(angle)
            moves[:, first + 2] = length * np.sin(angle)
        return moves

    @property
    def _brake(self) -> float:
        return self.strides - _CLOSING


def write_gait(
    action: str,
    *,
    start: Stand,
    body: Body,
    style: Style,
    seconds: float,
    random: np.random.Generator,
) -> Gait:
    """Choose steps for some seconds: walks stay in the room, turns face the sensor again."""
    gait = Gait(
        strides=0,
        cadence_hz=style.cadence_hz * float(random.uniform(0.93, 1.07)),
        length=0.0,
        turn=0.0,
        lift=0.06 * body.leg,
        swing=0.15 * style.amplitude,
    )
    gait = replace(gait, strides=max(3, round(seconds * gait.cadence_hz)))
    if action == "walk":
        length = style.stride * body.leg * float(random.uniform(0.9, 1.1))
        gait = replace(gait, length=length, lift=0.09 * body.leg, swing=0.42 * style.amplitude)
        return _curve_into_room(gait, start, random)
    if action == "turn":
        return _turn_to_sensor(gait, start, random)
    return replace(gait, lift=0.22 * body.leg * style.amplitude, swing=0.35 * style.amplitude)


def _curve_into_room(gait: Gait, start: Stand, random: np.random.Generator) -> Gait:
    """Walk along the first arc, of some drawn at random, that stays in the room and ends in it.

    Where none does, the one that does so best; the later ones may be shorter than asked for.
    """
    best, least = gait, np.inf
    begin = float(np.hypot(start.x, start.z - _MIDDLE[2]))
    for number in range(24):
        sharp = float(random.uniform(0.1, 1.4) * random.choice((-1.0, 1.0)))
        strides = gait.strides if number < 8 else int(random.integers(3, gait.strides + 1))
        arc = replace(gait, strides=strides, turn=sharp * gait.length)
        place, _ = arc.follow(start, np.linspace(0.0, strides - _CLOSING, 12))
        away = np.linalg.norm(place - _MIDDLE, axis=1)
        leaving = max(0.0, float(away.max()) - max(begin, _ROOM_RADIUS_M))
        cost = leaving + max(0.0, float(away[-1]) - 0.7 * _ROOM_RADIUS_M)
        if cost < least:
            best, least = arc, cost
    return best


def _turn_to_sensor(gait: Gait, start: Stand, random: np.random.Generator) -> Gait:
    """Turn to where the sensor is, about; or away from it, for who faces it already.

    Who has left the room turns back into it first.
    """
    goal = float(random.uniform(-0.4, 0.4))
    outside = leaves_room(start)
    away = bearing_to_middle(start) if outside else _wrap(goal - start.heading)
    if abs(away) < 0.7 and not outside:
        away -= float(np.sign(away)) * 1.6
    strides = max(3, min(gait.strides, round(2.5 + abs(away))))
    return replace(gait, strides=strides, turn=away / (strides - _CLOSING))


def bearing_to_middle(stands: Stand) -> float:
    """By how much somebody would have to turn to the left to face the middle of the room."""
    towards = _MIDDLE - np.array((stands.x, 0.0, stands.z))
    return _wrap(float(np.arctan2(-towards[0], -towards[2])) - stands.heading)


def leaves_room(stands: Stand) -> bool:
    """Whether somebody is near the edge of the room."""
    return float(np.hypot(stands.x, stands.z - _MIDDLE[2])) > 0.8 * _ROOM_RADIUS_M


def _wrap(angle: float) -> float:
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


def stand_feet(stands: Stand, count: int, body: Body) -> Feet:
    """Both feet flat beside each other."""
    heading = np.full((count, 2), stands.heading)
    position = _sideways(heading, body.half_stance) + np.array((stands.x, 0.0, stands.z))
    return Feet(position=position, heading=heading, pitch=np.zeros((count, 2)))


def stand_pose(style: Style) -> Float64[np.ndarray, " control"]:
    """Standing at ease: every other pose is told by what differs from this one."""
    pose = np.zeros(CONTROLS)
    pose[Control.LEAN] = style.stoop
    pose[Control.DROP] = 0.006
    for first in (Control.RIGHT_OUT, Control.LEFT_OUT):
        pose[first] = style.arm_carriage
        pose[first + 1] = -(1.0 - style.elbow)
        pose[first + 2] = 0.06
    return pose


def fidget(
    t: Float64[np.ndarray, " time"], *, style: Style, seed: int
) -> Float64[np.ndarray, "time control"]:
    """Sway, breathing and small drifts of a living person: slow, and never the same twice."""
    random = np.random.default_rng(seed)
    size = np.full(CONTROLS, 0.006)
    size[[Control.DROP, Control.NOD, Control.LOOK]] = (0.0008, 0.02, 0.03)
    size[[Control.BACK, Control.SIDE, Control.TWIST]] = (0.005, 0.007, 0.015)
    hertz = random.uniform(0.08, 0.45, size=(3, CONTROLS))
    start = random.uniform(0.0, 2.0 * np.pi, size=(3, CONTROLS))
    waves = np.sin(2.0 * np.pi * hertz * t[:, None, None] + start).sum(1)
    moves = waves * size * style.liveliness / np.sqrt(1.5)
    breath = np.sin(2.0 * np.pi * random.uniform(0.2, 0.32) * t)
    moves[:, Control.LEAN] -= 0.008 * breath
    moves[:, [Control.RIGHT_UP, Control.LEFT_UP]] += 0.006 * breath[:, None]
    return np.asarray(moves)


def minimum_jerk(share: Float64[np.ndarray, "*any"]) -> Float64[np.ndarray, "*any"]:
    """From 0 to 1 with no speed or acceleration at either end; held outside."""
    u = np.clip(share, 0.0, 1.0)
    return np.asarray(u**3 * (10.0 - 15.0 * u + 6.0 * u**2))


def _integrated_jerk(share: Float64[np.ndarray, "*any"]) -> Float64[np.ndarray, "*any"]:
    u = np.clip(share, 0.0, 1.0)
    return np.asarray(u**4 * (2.5 - 3.0 * u + u**2) + np.maximum(share - 1.0, 0.0))


def _sideways(
    heading: Float64[np.ndarray, "time 2"], half: float
) -> Float64[np.ndarray, "time 2 3"]:
    offsets = np.array(((half, 0.0, 0.0), (-half, 0.0, 0.0)))
    return np.asarray(np.einsum("tfij,fj->tfi", yaw(heading), offsets))
