"""What happened when in a take: its stages, its errors and its latency, all on one clock.

Times are seconds since `trial.start` left.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float64

from app.commands.client.messages import Forecast, Job, VersionChanged
from app.commands.figures import summarize
from benchmarks.live.check import Offline
from benchmarks.live.take import RATE_HZ, Take
from models.metrics import squared_errors_cm2
from models.spec import MotionSpec

HORIZON = MotionSpec().horizon
MEAN_S = 3.0
"""Errors are drawn as means over the last so many seconds."""
ENOUGH = 8
"""Fewer errors than this make no mean."""


class NothingToTellError(RuntimeError):
    """The take has no swap."""


@dataclass(frozen=True, slots=True)
class Stage:
    """Something that lasted a while."""

    kind: str
    begin: float
    end: float

    @property
    def seconds(self) -> float:
        return self.end - self.begin


@dataclass(frozen=True, slots=True)
class Swap:
    """How the version came to answer.

    Attributes:
        promoted: the job ended, and with it the version became active.
        told: the `version` message came.
        first: the first forecast by the version came.
    """

    promoted: float
    told: float
    first: float


@dataclass(frozen=True, eq=False)
class Errors:
    """Squared errors 500 ms ahead, in cm², as soon as the truth is there.

    Attributes:
        at: when the true pose was due.
        came: when its forecast had come.
        served, base, still: of the forecast that was served, of the base's for the same window,
            and of a person who stands still.
    """

    at: Float64[np.ndarray, " error"]
    came: Float64[np.ndarray, " error"]
    served: Float64[np.ndarray, " error"]
    base: Float64[np.ndarray, " error"]
    still: Float64[np.ndarray, " error"]

    def mean(self, chosen: np.ndarray) -> dict[str, Any]:
        """Give the mean errors of some of them."""
        names = ("served", "base", "still")
        told: dict[str, Any] = {"forecasts": int(chosen.sum())}
        if not chosen.any():
            return told
        return told | {
            f"{name}_cm2": round(float(getattr(self, name)[chosen].mean()), 2) for name in names
        }


def find_swap(take: Take, job: Mapping[str, Any]) -> Swap:
    """Find how the version came to answer.

    Raises:
        NothingToTellError: it did not.
    """
    told = [at for at, m in take.heard if isinstance(m, VersionChanged) and m.version.number]
    first = [at for at, m in take.heard if isinstance(m, Forecast) and m.version.number]
    if not told or not first:
        raise NothingToTellError(
            f"no version came: the job is {job['state']} ({job['reason']}). {job['message']}"
        )
    return Swap(_on_clock(take, job["finished_at"]), told[0] - take.began, first[0] - take.began)


def list_stages(take: Take, job: Mapping[str, Any], *, fit_steps: int) -> list[Stage]:
    """List what went on, from the first frame to the end.

    Beginning and end of the job are the database's; what the job did in between, the stream was
    told about once a second.

    Args:
        take: what was sent and heard.
        job: as the service shows it at last.
        fit_steps: of one fit; a job is a fit for each fold and one on everything.
    """
    started, ended = (_on_clock(take, job[name]) for name in ("started_at", "finished_at"))
    marks = [("recording", 0.0), ("queued", take.stopped - take.began), ("checking", started)]
    for at, message in take.heard:
        kind = _name_stage(message.progress, fit_steps) if isinstance(message, Job) else None
        if kind is not None and kind not in {known for known, _ in marks}:
            marks.append((kind, at - take.began))
    marks += [("answering", ended), ("end", find_end(take))]
    return [Stage(kind, begin, max(begin, end)) for (kind, begin), (_, end) in pairwise(marks)]


def _name_stage(progress: Mapping[str, Any] | None, fit_steps: int) -> str | None:
    match progress:
        case {"phase": "judging", "step": int(step)}:
            return f"judging {max(step - 1, 0) // fit_steps + 1}"
        case {"phase": "fitting"}:
            return "fitting"
        case _:
            return None


def find_end(take: Take) -> float:
    """Tell when the last frame was due."""
    return take.due[-1] - take.began


def measure_errors(take: Take, offline: Offline, *, base_sha256: str, speed: float) -> Errors:
    """Compare forecasts with what came, where the person was still in view by then."""
    rows = [
        i for i, p in enumerate(offline.places) if p.frame + HORIZON < len(take.clips[p.clip].poses)
    ]
    places = [offline.places[i] for i in rows]
    truth = np.stack([take.clips[p.clip].poses[p.frame + HORIZON] for p in places])
    due = np.array([take.due[offline.forecasts[i].seq] for i in rows])
    guesses = {
        "served": np.stack([offline.forecasts[i].frames[-1] for i in rows]),
        "base": offline.frames[base_sha256][rows, -1],
        "still": np.stack([take.find(place) for place in places]),
    }
    return Errors(
        at=due + HORIZON / RATE_HZ / speed - take.began,
        came=np.array([offline.received[i] for i in rows]) - take.began,
        **{
            name: squared_errors_cm2(guess[:, None], truth[:, None])[:, 0]
            for name, guess in guesses.items()
        },
    )


def smooth(
    at: Float64[np.ndarray, " error"],
    values: Float64[np.ndarray, " error"],
    *,
    step_s: float,
) -> tuple[Float64[np.ndarray, " point"], Float64[np.ndarray, " point"]]:
    """Give means over the last seconds at regular times; NaN where there is too little."""
    if not len(at):
        return np.empty(0), np.empty(0)
    times = np.arange(at[0], at[-1] + step_s, step_s)
    first, last = np.searchsorted(at, times - MEAN_S), np.searchsorted(at, times, side="right")
    total = np.concatenate([[0.0], np.cumsum(values)])
    count = last - first
    means = np.where(count >= ENOUGH, (total[last] - total[first]) / np.maximum(count, 1), np.nan)
    return times, means


def measure_latency(
    take: Take,
) -> tuple[Float64[np.ndarray, " forecast"], Float64[np.ndarray, " forecast"]]:
    """Give when each forecast came, and how many ms that was after its frame was due."""
    pairs = [(at, at - take.due[m.seq]) for at, m in take.heard if isinstance(m, Forecast)]
    came, late = np.array(pairs, dtype=np.float64).reshape(-1, 2).T
    return came - take.began, late * 1e3


def tell_latency(take: Take, stages: list[Stage], swap: Swap) -> dict[str, Any]:
    """Tell the latency before, while the worker was at it, and after."""
    came, late_ms = measure_latency(take)
    skipped = np.array([m.skipped for _, m in take.heard if isinstance(m, Forecast)])
    started = next(stage.begin for stage in stages if stage.kind == "checking")
    spans = {
        "before": (0.0, started),
        "during": (started, swap.told),
        "after": (swap.told, float("inf")),
    }
    told = {}
    for name, (begin, end) in spans.items():
        chosen = (came >= begin) & (came < end)
        spread = summarize(late_ms[chosen])
        told[name] = {
            "forecasts": int(chosen.sum()),
            "p50_ms": round(spread.median, 1),
            "p99_ms": round(spread.p99, 1),
            "within_33_ms": round(float((late_ms[chosen] <= 1e3 / RATE_HZ).mean()), 4),
            "skipped": int(skipped[chosen].sum()),
        }
    return told


def _on_clock(take: Take, instant: str) -> float:
    """Put an instant of the database on our clock; both are of this machine."""
    return datetime.fromisoformat(instant).timestamp() - take.began_wall
