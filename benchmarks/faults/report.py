"""The table of outcomes."""

import sys
from collections import Counter
from collections.abc import Sequence
from itertools import groupby
from statistics import median

from benchmarks.faults.campaign import Outcome

HEAD = (
    "| fault | repeats | the job was | recovered after s, median / max | forecasts answered "
    "| told to come again | lost trials | double versions | damaged weights | unanswered | wrong |"
)


def say(outcome: Outcome) -> None:
    """Tell about one repeat, while others wait."""
    wrong = [line for lines in outcome.findings.values() for line in lines]
    print(
        f"{outcome.fault}: {outcome.hit}, {outcome.job} at attempt {outcome.attempts}, "
        f"{outcome.recovered_s} s, {outcome.tries} tries, by {', '.join(outcome.versions)}, "
        f"{outcome.asked}+{outcome.streamed} answered, {outcome.refused} told to come again, "
        f"{outcome.closes or ''} {outcome.warned or ''} {'; '.join(wrong)}",
        file=sys.stderr,
        flush=True,
    )


def is_clean(outcomes: Sequence[Outcome]) -> bool:
    """Tell whether nothing was found."""
    return not any(any(outcome.findings.values()) for outcome in outcomes)


def tabulate(outcomes: Sequence[Outcome]) -> str:
    """Write one row for each fault."""
    rows = [HEAD, "|" + "---|" * (HEAD.count("|") - 1)]
    for fault, group in groupby(outcomes, key=lambda outcome: outcome.fault):
        rows.append(_write_row(fault, list(group)))
    return "\n".join(rows)


def _write_row(fault: str, outcomes: Sequence[Outcome]) -> str:
    hits = Counter(outcome.hit for outcome in outcomes)
    took = [outcome.recovered_s for outcome in outcomes]

    def count(kind: str) -> int:
        return sum(len(outcome.findings[kind]) for outcome in outcomes)

    cells = (
        fault,
        len(outcomes),
        ", ".join(f"{hit} {times}" for hit, times in hits.most_common()),
        f"{median(took):.1f} / {max(took):.1f}",
        sum(outcome.asked + outcome.streamed for outcome in outcomes),
        sum(outcome.refused for outcome in outcomes),
        *(count(kind) for kind in ("lost", "doubled", "damaged", "unanswered", "wrong")),
    )
    return "| " + " | ".join(str(cell) for cell in cells) + " |"
