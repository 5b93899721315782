"""Frames at any rate, with holes, in any skeleton: made into the window that the net sees.

The window is the grid `t_n - k/30` (k = 14 … 0) anchored at the newest frame. Times are float64 and
only ever used as differences to `t_n`, so seconds since 1970 do as well as seconds since start.
Shared by the stream, which pushes frame by frame, and by single requests, which bring an array.
"""

import math
from collections import deque
from dataclasses import dataclass
from statistics import median
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Float64
from msgspec import Struct

from app.domain.errors import (
    BadFrameError,
    GapInHistoryError,
    NoForecastError,
    PersonLostError,
    TimeNotIncreasingError,
    TooLittleHistoryError,
)
from app.live import guard
from app.live.frames import (
    ENOUGH_STEPS,
    SNAP_S,
    WindowRules,
    check_confidence,
    check_joints,
    check_times,
    is_within,
)
from app.live.history import History
from app.live.sightings import Sightings
from models.runtime.resample import Survey
from models.skeleton import Skeleton
from models.spec import MotionSpec

Restart = Literal["gap", "clock_restart"]
WaitReason = Literal["warm_up", "gap", "clock_restart", "person_lost", "overloaded"]

_STEPS = 9


class WindowReady(Struct, frozen=True):
    """A complete window.

    Attributes:
        window: metres, net skeleton, y up, 30 Hz, oldest first.
        last_joints: the newest frame in the user's skeleton and frame of reference, filled.
        t: time of the newest frame on the client's clock, seconds.
        flags: quality flags of the input.
        filled: names of the joints that were carried for longer than may pass in silence.
    """

    window: Float[np.ndarray, "15 20 3"]
    last_joints: Float[np.ndarray, "joint 3"]
    t: float
    flags: tuple[str, ...]
    filled: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Waiting:
    """Why there is no forecast yet: `have_s` of `need_s` seconds are there."""

    reason: WaitReason
    have_s: float
    need_s: float


class FrameBuffer:
    """The frames of one stream, and the window that ends at the newest of them.

    Grid points older than the oldest frame (by 17 ms at most) hold its pose.
    """

    def __init__(
        self,
        skeleton: Skeleton,
        *,
        up: str = "y",
        root_relative: bool = False,
        rules: WindowRules | None = None,
        spec: MotionSpec | None = None,
    ) -> None:
        self.rules = rules or WindowRules()
        self.spec = spec or MotionSpec()
        self._joints = len(skeleton.joints)
        self._root_relative = root_relative or skeleton.root_relative
        self._history = History(skeleton, up=up, rules=self.rules)
        self.likeness = guard.Likeness(self.rules.guard)
        self.sightings = Sightings()
        self._grid = -np.arange(self.spec.observe - 1, -1, -1) / self.spec.rate_hz
        self._span_s = -float(self._grid[0])
        self._steps: deque[float] = deque(maxlen=_STEPS)
        self._last_t: float | None = None
        self.clear()

    def clear(self, reason: WaitReason = "warm_up") -> None:
        """Forget the person, for instance after a jump of the frame of reference."""
        self._history.clear()
        self.likeness.clear()
        self._reason = reason
        self._unsure = False
        self._identical = 0
        self._raw: bytes | None = None

    @property
    def time_unit_is_wrong(self) -> bool:
        """Whether the last steps of `t` cannot be seconds of a sensor."""
        if len(self._steps) < ENOUGH_STEPS:
            return False
        return not self.rules.step_min_s <= median(self._steps) <= self.rules.step_max_s

    def push(
        self,
        t: float,
        joints: Float[np.ndarray, "joint 3"] | None,
        confidence: Float[np.ndarray, " number"] | None = None,
    ) -> Restart | None:
        """Take one frame.

        Args:
            t: capture time in seconds on the client's clock.
            joints: metres, in the user's skeleton and frame; NaN for a missing joint; None for a
                frame without the person.
            confidence: 0 … 1 per joint.

        Returns:
            Why everything before this frame was forgotten, None if it was not.

        Raises:
            BadFrameError: and its kinds; the frame is then as if it had never come.
        """
        pose = None if joints is None else np.ascontiguousarray(joints, np.float64)
        known = self._check(t, pose, confidence)
        restart = self._advance(t)
        if pose is None or not (known is None or known.any()):
            self._history.lost = True
            return restart
        raw = pose.tobytes()
        self._identical = self._identical + 1 if raw == self._raw else 1
        self._raw = raw
        self._unsure = confidence is not None and bool(
            (confidence < self.rules.unsure_below).mean() >= self.rules.unsure_share
        )
        if self._history.add(t, pose, known):
            self._reason = "person_lost"
        return restart

    def look(self, *, whole: bool = False) -> WindowReady | Waiting:
        """Give the window that ends at the newest frame, or why there is none.

        Args:
            whole: nothing was before and nothing comes after (a single request).
        """
        history, need_s = self._history, self.rules.complete_s
        if history.lost:
            return Waiting("person_lost", history.span_s, need_s)
        span_s = history.span_s
        if span_s < need_s - SNAP_S:
            return Waiting(self._reason, span_s, need_s)
        seen = history.survey(self._grid, recent_s=self.rules.guard.upside_down_s)
        window = history.to_net(seen.poses)
        filled = history.list_filled(since_s=self._span_s)
        flags = self._list_flags(window, seen, filled=bool(filled), whole=whole)
        return WindowReady(
            window=window,
            last_joints=history.newest.copy(),
            t=history.newest_t,
            flags=flags,
            filled=filled,
        )

    def _check(
        self,
        t: float,
        pose: Float64[np.ndarray, "joint 3"] | None,
        confidence: Float[np.ndarray, " number"] | None,
    ) -> Bool[np.ndarray, " known"] | None:
        """Refuse a frame before it has changed anything.

        Returns:
            Which joints it knows; None for all, and for a frame without the person.
        """
        if not math.isfinite(t):
            raise BadFrameError("t must be a finite number of seconds.")
        if self._last_t is not None and -self.rules.restart_s <= t - self._last_t <= 0:
            raise TimeNotIncreasingError(f"t must be above {self._last_t!r}, got {t!r}.")
        if confidence is not None:
            check_confidence(confidence, self._joints)
        if pose is None:
            return None
        limit, known = self.rules.coordinate_max_m, None
        if len(pose) != self._joints or not is_within(pose, limit):
            check_joints(pose, self._joints, coordinate_max_m=limit)
            known = ~np.isnan(pose).any(axis=1)
        if confidence is not None:
            sure = confidence >= self.rules.confidence_min
            known = sure if known is None else known & sure
        return None if known is None or known.all() else known

    def _advance(self, t: float) -> Restart | None:
        """Move the clock on; forget what lies before a restart or a gap."""
        step = 0.0 if self._last_t is None else t - self._last_t
        self._last_t = t
        if step > 0:
            self._steps.append(step)
        if step < 0:
            self.clear("clock_restart")
            return "clock_restart"
        if step > self.rules.gap_s + SNAP_S:
            self.clear("gap")
            return "gap"
        history = self._history
        if len(history) and t - history.times[-1] > self.rules.gap_s + SNAP_S:
            self.clear("person_lost")  # frames came, but nobody was in them
        return None

    def _give_poses(self, first: int) -> Float[np.ndarray, "recent 20 3"]:
        return self._history.to_net(self._history.poses[first:])

    def _list_flags(
        self, window: Float[np.ndarray, "15 20 3"], seen: Survey, *, filled: bool, whole: bool
    ) -> tuple[str, ...]:
        history, rules, rate_hz = self._history, self.rules.guard, self.spec.rate_hz
        flags = {
            "filled_joints": filled,
            "low_confidence": self._unsure,
            "gap": seen.longest_s > self.rules.neighbour_max_s + SNAP_S,
            "frozen_input": self._identical >= rules.frozen_poses,
            "implausible_pose": guard.moves_impossibly(window, rate_hz=rate_hz, rules=rules),
            "root_relative": self._root_relative,
            "not_this_person": self.likeness.look(history.times, self._give_poses),
        }
        # a frame before the second began shows that all of it was seen
        seen_enough = whole or seen.earlier > 0 or history.span_s >= rules.upside_down_s
        body = guard.judge_sums(seen.means, seen.tops, rules=rules, seen_enough=seen_enough)
        named = [flag for flag, holds in flags.items() if holds]
        found = (*named, *(flag for flag in body if flag not in named))
        if self.likeness.bones is not None and self.likeness.measured_t == history.newest_t:
            self.sightings.note(self.likeness.measured_t, self.likeness.bones, found)
        return found


def assemble(
    frames: Float[np.ndarray, "time joint 3"],
    t: Float[np.ndarray, " times"] | None,
    confidence: Float[np.ndarray, "confidences number"] | None,
    *,
    skeleton: Skeleton,
    up: str,
    root_relative: bool = False,
    bones: tuple[float, ...] | None = None,
    rules: WindowRules | None = None,
    spec: MotionSpec | None = None,
) -> WindowReady:
    """Make the window of a single request.

    Args:
        frames: metres, NaN for a missing joint.
        t: seconds, strictly increasing; without it the frames are 30 Hz and the newest is at 0.
        confidence: 0 … 1 per joint.
        skeleton: the user's format.
        up: the user's up axis.
        root_relative: whether the user's sensor has no global position.
        bones: of the person that the weights were made for, None if nobody knows; frames of a
            second show whether it is somebody else.
        rules: what counts as a window.
        spec: shape of the task.

    Raises:
        BadFrameError: and its kinds.
        NoForecastError: and its kinds, where the frames are good but not enough.
    """
    buffer = FrameBuffer(skeleton, up=up, root_relative=root_relative, rules=rules, spec=spec)
    if len(frames) == 0:
        raise TooLittleHistoryError("There are no frames.")
    if t is None:
        t = -np.arange(len(frames) - 1, -1, -1) / buffer.spec.rate_hz
    check_times(t, len(frames), buffer.rules)
    joints, limit = len(skeleton.joints), buffer.rules.coordinate_max_m
    check_joints(frames, joints, coordinate_max_m=limit)
    if confidence is not None:
        if len(confidence) != len(frames):
            raise BadFrameError(f"{len(confidence)} confidences for {len(frames)} frames.")
        check_confidence(confidence, joints)
    buffer.likeness.expect(bones)
    for i in range(len(frames)):  # all of them: an old frame may be where a joint was last seen
        buffer.push(float(t[i]), frames[i], None if confidence is None else confidence[i])
    outcome = buffer.look(whole=True)
    if isinstance(outcome, Waiting):
        raise _explain(outcome)
    return outcome


def _explain(waiting: Waiting) -> NoForecastError:
    have = f"{waiting.have_s:.3f} s of {waiting.need_s:g} s are there."
    if waiting.reason == "person_lost":
        return PersonLostError("The newest frame lacks the hip centre or over half of the joints.")
    if waiting.reason == "gap":
        return GapInHistoryError(f"After the gap, {have}")
    return TooLittleHistoryError(f"The frames must span {waiting.need_s:g} s; {have}")
