"""Believable synthetic people, for tests, demonstrations and training: no recording needed.

Every person has a body, a manner and a place in the room, all drawn from one seed. Motion is a
function of continuous time, so the same motion can be sampled at any rate. Poses are in the net's
skeleton, in metres, in the frame of UTD-MHAD: y up, right-handed, the person in front of the sensor
(at positive z) and by default facing it, with the right side at larger x.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import count

import numpy as np
from jaxtyping import Float32, Float64

from models.data.clips import Clip
from models.data.synthetic_actions import ACTIONS, Gesture, write_gesture
from models.data.synthetic_body import draw_body, pose_body
from models.data.synthetic_gait import (
    GAITS,
    Gait,
    Stand,
    Style,
    bearing_to_middle,
    fidget,
    leaves_room,
    stand_feet,
    stand_pose,
    write_gait,
)
from models.skeleton import NET_JOINTS

SOURCE = "synthetic"
_EVERYDAY = ("stand", "walk", "turn", "wave", "reach", "sit_and_work", "throw", "squat", "punch")


@dataclass(frozen=True, eq=False)
class _Segment:
    action: str
    begin: float
    start: Stand
    motion: Gait | Gesture

    @property
    def end(self) -> float:
        return self.begin + self.motion.seconds


class SyntheticPerson:
    """One person, the same for the same seed."""

    def __init__(self, seed: int) -> None:
        self.seed = seed
        random = np.random.default_rng((seed, 0))
        self.body = draw_body(random)
        self.style = _draw_style(random)
        self.floor = float(random.uniform(-1.15, -0.8))
        """Height of the floor below the sensor, metres."""
        self.home = Stand(
            x=float(random.uniform(-0.4, 0.4)),
            z=float(random.uniform(2.3, 3.2)),
            heading=float(random.normal(0.0, 0.2)),
        )

    def perform(
        self,
        actions: Sequence[str] | None = None,
        *,
        seconds: float = 4.0,
        take: int = 0,
        endless: bool = False,
    ) -> "Performance":
        """Do some actions one after another.

        Args:
            actions: of `ACTIONS`; None goes on for ever with one everyday action after another.
            seconds: how long each lasts, about; never shorter than it takes.
            take: another take of the same actions differs in detail.
            endless: begin again after the last action.

        Raises:
            ValueError: for an unknown action, or a time that is not positive.
        """
        unknown = sorted(set(actions or ()) - set(ACTIONS))
        if unknown:
            raise ValueError(f"unknown actions {unknown}; there are {', '.join(ACTIONS)}")
        if not 0 < seconds < np.inf:
            raise ValueError(f"seconds must be positive, got {seconds}")
        return Performance(self, actions, seconds=seconds, take=take, endless=endless)

    def record(
        self,
        action: str,
        seconds: float,
        rate_hz: float = 30.0,
        *,
        take: int = 0,
        noise: bool = False,
    ) -> Float32[np.ndarray, "time 20 3"]:
        """Record one action.

        Args:
            action: one of `ACTIONS`.
            seconds: length of the recording; the action is repeated or cut as it fits.
            rate_hz: frames per second.
            take: another take differs in detail.
            noise: add what a sensor like the Kinect adds.

        Returns:
            `round(seconds * rate_hz)` poses in metres.
        """
        times = np.arange(round(seconds * rate_hz)) / rate_hz
        poses = self.perform([action], seconds=seconds, take=take).pose_at(times)
        if noise:
            poses = poses + SensorNoise(_mix(self.seed, take, 1)).sample(times)
        return poses.astype(np.float32)

    def stream(
        self,
        rate_hz: float = 30.0,
        *,
        actions: Sequence[str] | None = None,
        seconds: float | None = None,
        take: int = 0,
        noise: bool = True,
    ) -> Iterator[tuple[float, Float32[np.ndarray, "20 3"]]]:
        """Yield time in seconds and pose, as a sensor would; it does not wait between frames.

        Args:
            rate_hz: frames per second.
            actions: to do over and over; None is a mixture of everyday ones.
            seconds: when to end; None never ends.
            take: another take differs in detail.
            noise: add what a sensor like the Kinect adds.
        """
        performance = self.perform(actions, take=take, endless=True)
        sensor = SensorNoise(_mix(self.seed, take, 1))
        for frame in count() if seconds is None else range(round(seconds * rate_hz)):
            time = np.array([frame / rate_hz])
            pose = performance.pose_at(time)
            if noise:
                pose = pose + sensor.sample(time)
            yield frame / rate_hz, pose[0].astype(np.float32)


class Performance:
    """A person's motion as a function of time.

    Segments are written as time goes on, always in the same order, so `pose_at` gives the same
    poses however it is asked.
    """

    def __init__(
        self,
        person: SyntheticPerson,
        actions: Sequence[str] | None,
        *,
        seconds: float,
        take: int,
        endless: bool,
    ) -> None:
        self.person = person
        self._endless = endless or actions is None
        self._actions = tuple(actions or _EVERYDAY)
        self._shuffled = actions is None
        self._each = seconds
        self._random = np.random.default_rng((person.seed, 1, take))
        self._fidget_seed = _mix(person.seed, take, 2)
        self._segments: list[_Segment] = []
        self._stands = person.home

    def pose_at(self, times: Float64[np.ndarray, " time"]) -> Float64[np.ndarray, "time 20 3"]:
        """Poses at some times in seconds, without sensor noise, in metres.

        Before the start and after the last action the person stands.
        """
        poses = np.empty((len(times), NET_JOINTS, 3))
        self._write_until(float(times.max(initial=0.0)))
        begins = np.array([segment.begin for segment in self._segments])
        which = np.clip(np.searchsorted(begins, times, side="right") - 1, 0, None)
        for index in np.unique(which):
            here = which == index
            poses[here] = self._pose_segment(self._segments[index], times[here])
        return poses

    def action_at(self, time: float) -> str:
        """Name what is being done at a time."""
        self._write_until(time)
        begun = [segment.action for segment in self._segments if segment.begin <= time]
        return begun[-1] if begun else self._segments[0].action

    def _write_until(self, time: float) -> None:
        while not self._segments or (
            self._segments[-1].end <= time
            and (self._endless or len(self._segments) < len(self._actions))
        ):
            self._write_segment()

    def _write_segment(self) -> None:
        person, random = self.person, self._random
        action = self._next_action()
        begin = self._segments[-1].end if self._segments else 0.0
        motion: Gait | Gesture
        if action in GAITS:
            motion = write_gait(
                action,
                start=self._stands,
                body=person.body,
                style=person.style,
                seconds=self._each,
                random=random,
            )
        else:
            motion = write_gesture(action, style=person.style, seconds=self._each, random=random)
        self._segments.append(_Segment(action, begin, self._stands, motion))
        if isinstance(motion, Gait):
            self._stands = motion.end(self._stands)

    def _next_action(self) -> str:
        if not self._shuffled:
            return self._actions[len(self._segments) % len(self._actions)]
        if leaves_room(self._stands):
            return "turn" if abs(bearing_to_middle(self._stands)) > 0.9 else "walk"
        # Somebody who has turned away turns back before doing something for the sensor.
        if abs((self._stands.heading + np.pi) % (2.0 * np.pi) - np.pi) > 0.9:
            return "turn"
        return str(self._random.choice(self._actions))

    def _pose_segment(
        self, segment: _Segment, times: Float64[np.ndarray, " time"]
    ) -> Float64[np.ndarray, "time 20 3"]:
        body, style, motion = self.person.body, self.person.style, segment.motion
        local = np.clip(times - segment.begin, 0.0, motion.seconds)
        controls = fidget(times, style=style, seed=self._fidget_seed)
        if isinstance(motion, Gait):
            phase = local * motion.cadence_hz
            controls += stand_pose(style) + motion.sway(phase, body=body, style=style)
            place, heading = motion.follow(segment.start, motion.progress(phase))
            feet = motion.feet(segment.start, phase, body)
        else:
            controls += motion.controls(local)
            heading = np.full(len(times), segment.start.heading)
            place = np.broadcast_to((segment.start.x, 0.0, segment.start.z), (len(times), 3))
            feet = stand_feet(segment.start, len(times), body)
        poses = pose_body(body, place=place, heading=heading, controls=controls, feet=feet)
        return np.asarray(poses + np.array((0.0, self.person.floor, 0.0)))


class SensorNoise:
    """What a sensor like the Kinect adds: white noise per frame, and slow offsets of each joint.

    Extremities are found less well than the trunk.
    """

    def __init__(self, seed: int, *, white_m: float = 0.004, slow_m: float = 0.008) -> None:
        self._random = np.random.default_rng(seed)
        self._white = white_m
        self._hertz = self._random.uniform(0.03, 0.25, size=(3, NET_JOINTS, 3))
        self._start = self._random.uniform(0.0, 2.0 * np.pi, size=(3, NET_JOINTS, 3))
        self._share = np.ones((NET_JOINTS, 1))
        self._share[[6, 7, 10, 11, 14, 15, 18, 19]] = 1.5
        self._slow = slow_m / np.sqrt(1.5)

    def sample(self, times: Float64[np.ndarray, " time"]) -> Float64[np.ndarray, "time 20 3"]:
        """Draw noise for frames at these times, in the order in which they are asked for."""
        angle = 2.0 * np.pi * self._hertz * times[:, None, None, None] + self._start
        slow = self._slow * np.sin(angle).sum(1)
        white = self._random.normal(0.0, self._white, size=(len(times), NET_JOINTS, 3))
        return np.asarray((slow + white) * self._share)


def synthetic_clips(
    people: int,
    seed: int,
    *,
    actions: Sequence[str] = ACTIONS,
    takes: int = 1,
    seconds: float = 4.0,
    noise: bool = True,
) -> list[Clip]:
    """Record several people doing several actions.

    Args:
        people: how many; they are subjects "1", "2", …
        seed: the same seed gives the same people and clips.
        actions: of `ACTIONS`.
        takes: trials of each action, "1", "2", …
        seconds: length of a clip.
        noise: add what a sensor like the Kinect adds.

    Returns:
        clips at 30 Hz with the source "synthetic", ordered by person, action and trial.
    """
    clips = []
    for number in range(people):
        person = SyntheticPerson(_mix(seed, number, 3))
        for action in actions:
            for take in range(takes):
                poses = person.record(action, seconds, take=take, noise=noise)
                clips.append(Clip(poses, str(number + 1), action, str(take + 1), SOURCE))
    return clips


def _draw_style(random: np.random.Generator) -> Style:
    return Style(
        tempo=float(random.uniform(0.8, 1.2)),
        amplitude=float(random.uniform(0.75, 1.15)),
        stoop=float(random.uniform(-0.02, 0.12)),
        right_handed=bool(random.uniform() < 0.88),
        arm_carriage=float(random.uniform(0.04, 0.17)),
        elbow=float(random.uniform(0.012, 0.045)),
        stride=float(random.uniform(1.0, 1.35)),
        cadence_hz=float(random.uniform(0.75, 0.98)),
        liveliness=float(random.uniform(0.6, 1.4)),
    )


def _mix(*numbers: int) -> int:
    """Make one seed of several, so that neighbouring seeds have nothing in common."""
    return int(np.random.SeedSequence(numbers).generate_state(1)[0])
