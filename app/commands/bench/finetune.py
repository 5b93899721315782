"""`kinecast bench finetune`: one person after another, checked, trained and judged."""

import os
import resource
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from app.commands.figures import summarize
from app.personalize.offline import personalize
from models.checkpoint import SHIPPED
from models.data.clips import Clip
from models.data.synthetic import SyntheticPerson
from models.data.synthetic_actions import ACTIONS


@dataclass(frozen=True, slots=True)
class FinetunePlan:
    """What to measure.

    Attributes:
        users: how many people, one after another.
        clips: clips of each person's trial.
        seconds: length of a clip.
        steps: of one fit, None for those of the recipe.
        threads: of torch's arithmetic.
        model: a checkpoint, None for the shipped one.
    """

    users: int
    clips: int
    seconds: float
    steps: int | None
    threads: int
    model: Path | None


def measure_finetune(plan: FinetunePlan) -> dict[str, Any]:
    """Time whole runs: checks, the fits for the judge, the judge, and the final fit."""
    base = (plan.model or SHIPPED).read_bytes()
    seconds: list[float] = []
    verdicts: dict[str, int] = {}
    size = steps = 0

    def report(values: Mapping[str, Any]) -> None:
        nonlocal steps
        steps = int(values.get("step", steps))

    for user in range(plan.users):
        clips = invent_trial(user, clips=plan.clips, seconds=plan.seconds)
        began = time.perf_counter()
        outcome = personalize(base, clips, report, threads=plan.threads, steps=plan.steps)
        seconds.append(time.perf_counter() - began)
        verdicts[str(outcome.verdict)] = verdicts.get(str(outcome.verdict), 0) + 1
        size = len(outcome.blob or b"")
    return {
        "benchmark": "finetune",
        "users": plan.users,
        "clips": plan.clips,
        "threads": plan.threads,
        "cores": os.cpu_count(),
        "load_average": [round(load, 2) for load in os.getloadavg()],
        "steps": steps,
        "bytes_per_version": size,
        "peak_memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024,
        "verdicts": verdicts,
        "seconds": summarize(seconds).as_json(),
        "ms_per_step": round(1e3 * sum(seconds) / (len(seconds) * max(steps, 1)), 2),
    }


def invent_trial(user: int, *, clips: int, seconds: float) -> list[Clip]:
    """Make one synthetic person's trial, each clip another action."""
    person = SyntheticPerson(user)
    names = [ACTIONS[i % len(ACTIONS)] for i in range(clips)]
    return [
        Clip(person.record(name, seconds), str(user), f"{name} {i}", "1", "synthetic")
        for i, name in enumerate(names)
    ]
