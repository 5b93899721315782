"""Linear regression on the window: five seconds to fit, and a person's in closed form."""

import operator
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64
from torch import Tensor

from models.data.clips import Clip
from models.data.splits import PERSONAL_TRIAL
from models.data.windows import Windows
from models.skeleton import HIP_CENTER

STRENGTHS = (1e-4, 3e-4, 1e-3, 3e-3, 1e-2)
ADAPTATIONS = (1.0, 3.0, 10.0, 30.0, 100.0)
_CHUNK = 2048
_TINY = 1e-12


@dataclass(frozen=True)
class _Moments:
    """Everything that least squares needs to know about some windows; they add up."""

    xx: Float64[Tensor, "feature feature"]
    xy: Float64[Tensor, "feature target"]
    yy: Float64[Tensor, " horizon"]
    windows: int

    def __add__(self, other: "_Moments") -> "_Moments":
        return _Moments(
            xx=self.xx + other.xx,
            xy=self.xy + other.xy,
            yy=self.yy + other.yy,
            windows=self.windows + other.windows,
        )

    def compare_to_zero_velocity(self, weights: Float64[Tensor, "feature target"]) -> float:
        """Mean over frames of the squared error ÷ zero velocity's, without the windows.

        Plain squared error would choose by the last frames alone, which are the hardest.
        """
        fitted = (weights * (self.xx @ weights - 2 * self.xy)).sum(0)
        errors = fitted.reshape(len(self.yy), -1).sum(1) + self.yy
        return float((errors / self.yy.clamp_min(_TINY)).mean())


_People = dict[tuple[str, str], dict[str, _Moments]]
"""For each person, the windows of the personal trial and of the others, where there are any."""


@dataclass(frozen=True, eq=False)
class Ridge:
    """Linear regression from the window to the displacement of every future frame.

    The window is taken relative to its last hip centre; a constant is appended; the target is the
    displacement from the last pose. Regularised towards zero velocity, by a strength chosen by
    leaving people out. `personalize` has a closed form too: regularised towards the base weights.

    Attributes:
        weights: float64, observed coordinates and the constant to displacements, metres to metres.
        horizon: frames of the forecast.
        strength: regularisation of the base weights, per window.
        adaptation: regularisation of personal weights towards the base, whatever the number of
            windows, so that more of them move the weights further.
    """

    weights: Float64[Tensor, "feature target"]
    horizon: int
    strength: float
    adaptation: float

    @classmethod
    def fit(
        cls,
        windows: Windows,
        *,
        clips: Sequence[Clip],
        personal_trial: str = PERSONAL_TRIAL,
        strengths: Sequence[float] = STRENGTHS,
        adaptations: Sequence[float] = ADAPTATIONS,
    ) -> "Ridge":
        """Fit the base weights and choose both strengths by leaving each person out in turn.

        Args:
            windows: cut from `clips`; of training people only.
            clips: whose clip each window is from.
            personal_trial: the trial by which adaptation to a left-out person is rehearsed; it is
                judged on the person's other trials.
            strengths: choices of `strength`; with one, nothing is left out for it.
            adaptations: choices of `adaptation`; the first one is taken where no person has the
                personal trial as well as another.

        Raises:
            ValueError: if there is a choice to make and only one person to make it on.
        """
        people = _gather_moments(windows, clips, personal_trial)
        if len(people) < 2 and max(len(strengths), len(adaptations)) > 1:
            raise ValueError("choosing a regularisation needs windows of at least two people")
        strength = _choose_strength(people, strengths)
        adaptation = _choose_adaptation(people, strength, adaptations)
        weights = _Solver(_add(people.values())).solve_base(strength)
        return cls(weights, windows.future.shape[1], strength, adaptation)

    def personalize(self, windows: Windows) -> "Ridge":
        """Fit a person's windows, regularised towards these weights."""
        solver = _Solver(_measure(windows.observed, windows.future))
        return replace(self, weights=solver.solve(self.adaptation, prior=self.weights))

    def __call__(
        self, window: Float[Tensor, "batch observe joint xyz"]
    ) -> Float32[Tensor, "batch horizon joint xyz"]:
        """Forecast linearly.

        Raises:
            ValueError: for windows of another shape than those it was fitted on.
        """
        features = _to_features(window)
        if features.shape[1] != len(self.weights):
            raise ValueError(f"windows of shape {tuple(window.shape[1:])} do not fit the weights")
        moved = features @ self.weights.to(window.device)
        displacement = moved.reshape(len(window), self.horizon, *window.shape[2:])
        return (window[:, -1:].double() + displacement).float()


class _Solver:
    """Solves for many strengths at the price of one eigendecomposition."""

    def __init__(self, moments: _Moments) -> None:
        self.moments = moments
        self.values, self.vectors = torch.linalg.eigh(moments.xx)

    def solve_base(self, strength: float) -> Float64[Tensor, "feature target"]:
        """Minimise mean squared error + strength × squared weights."""
        return self.solve(strength * self.moments.windows)

    def solve(
        self, strength: float, *, prior: Float64[Tensor, "feature target"] | None = None
    ) -> Float64[Tensor, "feature target"]:
        """Minimise squared error + strength × squared distance from the prior (zero if None)."""
        target = self.moments.xy if prior is None else self.moments.xy + strength * prior
        shrunk = self.vectors.T @ target / (self.values.clamp_min(0) + strength)[:, None]
        solution: Tensor = self.vectors @ shrunk
        return solution


def _to_features(
    window: Float[Tensor, "batch observe joint xyz"],
) -> Float64[Tensor, "batch feature"]:
    centred = window.double() - window[:, -1:, HIP_CENTER : HIP_CENTER + 1].double()
    flat = centred.flatten(1)
    return torch.cat([flat, flat.new_ones(len(flat), 1)], dim=1)


def _measure(
    observed: Float32[np.ndarray, "window observe joint 3"],
    future: Float32[np.ndarray, "window horizon joint 3"],
) -> _Moments:
    """Sum up windows in float64, some at a time, so that memory does not grow with them."""
    features, targets = observed[0].size + 1, future[0].size
    xx = torch.zeros(features, features, dtype=torch.float64)
    xy = torch.zeros(features, targets, dtype=torch.float64)
    yy = torch.zeros(future.shape[1], dtype=torch.float64)
    for start in range(0, len(observed), _CHUNK):
        window = torch.from_numpy(observed[start : start + _CHUNK])
        truth = torch.from_numpy(future[start : start + _CHUNK])
        x = _to_features(window)
        y = (truth.double() - window[:, -1:].double()).flatten(1)
        xx.addmm_(x.T, x)
        xy.addmm_(x.T, y)
        yy += y.square().reshape(len(y), len(yy), -1).sum((0, 2))
    return _Moments(xx=xx, xy=xy, yy=yy, windows=len(observed))


def _gather_moments(windows: Windows, clips: Sequence[Clip], personal_trial: str) -> _People:
    """Sum up each person's windows, those of the personal trial apart from the others."""
    people = [clip.person for clip in clips]
    personal = np.array([clip.trial == personal_trial for clip in clips])
    gathered: _People = {}
    for person in sorted(set(people)):
        own = np.array([other == person for other in people])
        for part, chosen in (("personal", own & personal), ("others", own & ~personal)):
            picked = chosen[windows.clip]
            if picked.any():
                moments = _measure(windows.observed[picked], windows.future[picked])
                gathered.setdefault(person, {})[part] = moments
    return gathered


def _add(people: Iterable[dict[str, _Moments]]) -> _Moments:
    return reduce(operator.add, (moments for parts in people for moments in parts.values()))


def _leave_out(people: _People, person: tuple[str, str]) -> _Moments:
    return _add(parts for other, parts in people.items() if other != person)


def _choose_strength(people: _People, strengths: Sequence[float]) -> float:
    """Choose by the error on each person of weights fitted on the others."""
    if len(strengths) == 1:
        return strengths[0]
    errors = np.zeros(len(strengths))
    for person, parts in people.items():
        solver = _Solver(_leave_out(people, person))
        own = _add([parts])
        errors += [own.compare_to_zero_velocity(solver.solve_base(choice)) for choice in strengths]
    return strengths[int(errors.argmin())]


def _choose_adaptation(people: _People, strength: float, adaptations: Sequence[float]) -> float:
    """Choose by the error on each person's other trials after adapting to the personal one."""
    errors = np.zeros(len(adaptations))
    if len(adaptations) == 1:
        return adaptations[0]
    for person, parts in people.items():
        if len(parts) == 2:
            prior = _Solver(_leave_out(people, person)).solve_base(strength)
            solver = _Solver(parts["personal"])
            errors += [
                parts["others"].compare_to_zero_velocity(solver.solve(choice, prior=prior))
                for choice in adaptations
            ]
    return adaptations[int(errors.argmin())]
