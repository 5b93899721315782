"""The planner's constants, chosen on people who are not reported on."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from benchmarks.planning.people import Say, Scene
from benchmarks.planning.robot import Constants
from benchmarks.planning.rounds import Round, play

METHOD = "zero velocity"
"""The constants are those that suit this one best, so that none of our forecasts is favoured."""
WEIGHTS = (10.0, 30.0, 100.0)
MARGINS = (0.10, 0.15, 0.20, 0.25, 0.30, 0.40)
PRICE_M = 10.0
"""What a second too close costs, in metres of progress. A choice of ours; the curve over margins
shows what others would lead to."""


def choose_constants(
    scenes: Sequence[Scene], *, say: Say
) -> tuple[Constants, list[dict[str, Any]]]:
    """Try every combination with zero velocity, and give the best one and what each came to."""
    tried = []
    for weight in WEIGHTS:
        for margin in MARGINS:
            constants = replace(Constants(), weight=weight, margin=margin)
            value = score([play(scene, METHOD, 0, constants) for scene in scenes])
            tried.append({"weight": weight, "margin": margin, "score": round(value, 4)})
            say(f"weight {weight:g}, margin {margin:g} m: {value:.3f} m/s")
    best = max(tried, key=lambda row: row["score"])
    return replace(Constants(), weight=best["weight"], margin=best["margin"]), tried


def score(rounds: Sequence[Round]) -> float:
    """Give metres of progress a second, less the price of being too close."""
    seconds = sum(one.seconds for one in rounds)
    close = sum(one.too_close_s for one in rounds)
    return (sum(one.progress_m for one in rounds) - PRICE_M * close) / seconds
