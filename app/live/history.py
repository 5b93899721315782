"""The last second of one person, with the joints that the sensor lost carried along."""

import math
from collections import deque

import numpy as np
from jaxtyping import Bool, Float, Float64

from app.live import guard
from app.live.frames import SNAP_S, WindowRules
from models.runtime.resample import Survey, survey
from models.skeleton import HIP_CENTER, Skeleton, to_y_up

CAPACITY = 160
"""Frames kept: over a second at 120 Hz."""


class History:
    """Frames in the user's skeleton and frame of reference, without holes.

    A missing joint is carried along with the hips (or, before it was ever seen, put where the
    nearest joint is that was seen). When it comes back, what was carried is replaced by the line
    between the two observations, so that its return is no jump; but `list_filled` names it until
    the hole has left the window.
    """

    def __init__(self, skeleton: Skeleton, *, up: str, rules: WindowRules) -> None:
        joints = len(skeleton.joints)
        self.lost = True
        self._skeleton, self._up, self._rules = skeleton, up, rules
        self._root = skeleton.to_net[HIP_CENTER]
        self._of_root = self._root != 0
        self._nearest = _order_by_distance(skeleton)
        self._times = np.zeros(2 * CAPACITY)
        self._poses = np.zeros((2 * CAPACITY, joints, 3))
        self._facts = np.zeros((2 * CAPACITY, guard.FACTS))
        self.clear()

    def clear(self) -> None:
        """Forget the person."""
        joints = len(self._skeleton.joints)
        self._start = self._end = 0
        self._seen_t = np.full(joints, -math.inf)
        self._mended_t = np.full(joints, -math.inf)
        self._offsets = np.full((joints, 3), math.nan)
        self._root_t = self._whole_since = -math.inf
        self._is_whole = True
        self.lost = True

    def __len__(self) -> int:
        return self._end - self._start

    @property
    def times(self) -> Float[np.ndarray, " frames"]:
        """Client's clock, seconds, oldest first."""
        return self._times[self._start : self._end]

    @property
    def poses(self) -> Float[np.ndarray, "frames joint 3"]:
        """Metres, missing joints filled."""
        return self._poses[self._start : self._end]

    @property
    def newest(self) -> Float64[np.ndarray, "joint 3"]:
        """The newest pose, missing joints filled."""
        return np.asarray(self._poses[self._end - 1])

    @property
    def newest_t(self) -> float:
        """Its time."""
        return float(self._times[self._end - 1])

    @property
    def span_s(self) -> float:
        """Time from the oldest to the newest frame."""
        if self._start == self._end:
            return 0.0
        return float(self._times[self._end - 1] - self._times[self._start])

    def survey(self, grid: Float64[np.ndarray, " points"], *, recent_s: float) -> Survey:
        """Put the poses on a grid of times before the newest, and sum up the guard's facts."""
        part = (self._start, self._end)
        return survey(
            self._times, self._poses, self._facts, part, grid, snap_s=SNAP_S, recent_s=recent_s
        )

    def to_net(self, poses: Float[np.ndarray, "*time joint 3"]) -> Float[np.ndarray, "*time 20 3"]:
        """Bring poses of the user into the net's skeleton, y up."""
        upright = poses if self._up == "y" else to_y_up(poses, self._up)
        return upright if self._skeleton.is_net else np.asarray(self._skeleton.to_net @ upright)

    def add(
        self,
        t: float,
        joints: Float64[np.ndarray, "joint 3"],
        known: Bool[np.ndarray, " joint"] | None,
    ) -> bool:
        """Append a frame of which at least one joint is known.

        Args:
            t: seconds.
            joints: metres.
            known: which joints are known, None for all.

        Returns:
            Whether the hips are back after so long that everything before was forgotten.
        """
        has_root = known is None or bool(known[self._of_root].all())
        too_long = t - self._root_t > self._rules.gap_s + SNAP_S
        forgotten = has_root and too_long and self._end > self._start
        if forgotten:
            self.clear()
        if has_root:
            self._root_t = t
        if known is None and self._is_whole:  # as nearly always
            self.lost = False
            self._append(t, joints)
        else:
            self._add_mended(t, joints, np.ones(len(joints), bool) if known is None else known)
        return forgotten

    def _add_mended(
        self, t: float, joints: Float64[np.ndarray, "joint 3"], known: Bool[np.ndarray, " joint"]
    ) -> None:
        """Append a frame where joints are missing, or are back."""
        self._catch_up()
        is_whole, has_root = bool(known.all()), bool(known[self._of_root].all())
        hidden = t - self._root_t > self._rules.missing_max_s + SNAP_S
        self.lost = not is_whole and (hidden or 2 * int(np.count_nonzero(known)) < len(known))
        self._append(t, joints if is_whole else self._fill(joints, known, has_root=has_root))
        self._mend(t, known)
        self._whole_since = math.inf if not is_whole else t
        self._is_whole = is_whole
        if has_root:
            pose = self._poses[self._end - 1]
            self._offsets[known] = pose[known] - self._root @ pose
        self._seen_t[known] = t

    def _catch_up(self) -> None:
        """Note of the newest frame, if it is whole, what nobody needs before a joint is missing."""
        if self._is_whole and self._end > self._start:
            pose = self._poses[self._end - 1]
            np.subtract(pose, self._root @ pose, out=self._offsets)
            self._seen_t.fill(self._times[self._end - 1])

    def list_filled(self, *, since_s: float) -> tuple[str, ...]:
        """Name the joints that were missing for too long in the last `since_s` seconds."""
        newest, oldest = self.times[-1], self.times[0]
        if newest - self._whole_since > since_s:
            return ()
        self._catch_up()
        absent = newest - np.maximum(self._seen_t, oldest)
        missing = (absent > self._rules.missing_max_s + SNAP_S) | np.isinf(self._seen_t)
        mended = self._mended_t > newest - since_s
        return tuple(self._skeleton.joints[j] for j in np.flatnonzero(missing | mended))

    def _append(self, t: float, pose: Float[np.ndarray, "joint 3"]) -> None:
        if self._end == len(self._times):
            kept = len(self)
            for array in (self._times, self._poses, self._facts):
                array[:kept] = array[self._start : self._end]
            self._start, self._end = 0, kept
        self._times[self._end], self._poses[self._end] = t, pose
        guard.note_body(self.to_net(pose), self._facts, self._end)
        self._end += 1
        self._start = max(self._start, self._end - CAPACITY)

    def _fill(
        self,
        joints: Float[np.ndarray, "joint 3"],
        known: Bool[np.ndarray, " joint"],
        *,
        has_root: bool,
    ) -> Float[np.ndarray, "joint 3"]:
        """Carry the missing joints: with the hips where they are known, else where they were."""
        pose = np.where(known[:, None], joints, math.nan)
        if has_root:
            root = self._root @ np.where(known[:, None], joints, 0.0)
            pose[~known] = root + self._offsets[~known]
        elif len(self):
            pose[~known] = self.poses[-1][~known]
        for j in np.flatnonzero(np.isnan(pose).any(axis=1)):
            pose[j] = joints[next(k for k in self._nearest[j] if known[k])]
        return pose

    def _mend(self, t: float, known: Bool[np.ndarray, " joint"]) -> None:
        """Draw the lines of the joints that are back."""
        if len(self) < 2:
            return
        back = known & (self._seen_t < self.times[-2])
        for j in sorted(np.flatnonzero(back).tolist(), key=lambda j: not self._of_root[j]):
            hole_s = t - max(float(self._seen_t[j]), float(self.times[0]))
            is_long = hole_s > self._rules.missing_max_s + SNAP_S
            if is_long:
                self._mended_t[j] = t
            self._draw_line(j, along_hips=is_long and not self._of_root[j])

    def _draw_line(self, joint: int, *, along_hips: bool) -> None:
        """Let a joint go from where it was last seen to where it is now.

        A short hole is bridged in the room. During a long one the person may have walked on, so
        there the line is one of offsets to the hips.
        """
        seen, times = self._seen_t[joint], self.times[:-1]
        first = int(np.searchsorted(times, seen, side="right"))
        hole = self.poses[first:-1]
        now = self.poses[-1, joint].copy()
        base = np.zeros((len(hole), 3))
        if along_hips or first == 0:
            base, now = self._root @ hole, now - self._root @ self.poses[-1]
            old = self._offsets[joint]
        else:
            old = self.poses[first - 1, joint]
        if np.isnan(old).any():  # never seen before
            old, seen = now, times[0]
        share = (times[first:] - seen) / (self.times[-1] - seen)
        hole[:, joint] = base + old + share[:, None] * (now - old)


def _order_by_distance(skeleton: Skeleton) -> list[list[int]]:
    """For each joint, list all others by their number of bones away."""
    joints = len(skeleton.joints)
    near: list[set[int]] = [set() for _ in range(joints)]
    for a, b in skeleton.bones:
        near[a].add(b)
        near[b].add(a)
    ordered = []
    for start in range(joints):
        found, seen = deque([start]), [start]
        while found:
            for k in sorted(near[found.popleft()] - set(seen)):
                seen.append(k)
                found.append(k)
        ordered.append(seen[1:] + [k for k in range(joints) if k not in seen])
    return ordered
