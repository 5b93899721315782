"""The figures of one run: what was felt, what it cost, and what this machine did to it."""

from collections.abc import Callable, Sequence
from statistics import median
from typing import Any

import numpy as np
from jaxtyping import Float64

from app.commands.bench.accounts import StreamLog, measure_shares
from app.commands.bench.generator import Load
from app.commands.bench.probe import PAUSE_S, find_overlaps
from app.commands.bench.usage import describe_usage
from app.commands.figures import summarize

DEADLINE_MS = 33.0

Times = Float64[np.ndarray, " frame"]


def describe_load(load: Load) -> dict[str, Any]:
    """Give the figures of one run, with the machine's own pauses and without them.

    Clients that read slowly on purpose are told of apart from the others.
    """
    slow = [log for log in load.streams if log.slow]
    others = [log for log in load.streams if not log.slow]
    told = {
        **_judge(others, load),
        "frames": _count_frames(load),
        "fairness": describe_fairness(others),
        "server_ms": _describe_server(load),
        "usage": _describe_usage(load),
        "host": _describe_host(load),
    }
    told["clients"] = _describe_clients(load.streams)
    if slow:
        told["slow_readers"] = {"streams": len(slow), **_judge(slow, load)}
    return told


def describe_fairness(logs: Sequence[StreamLog]) -> dict[str, float | None]:
    """Give the share of their frames that were answered, for the worst user and the median one."""
    shares = measure_shares(logs)
    if not shares:
        return {"worst_user_answered": None, "median_user_answered": None}
    return {
        "worst_user_answered": round(min(shares), 5),
        "median_user_answered": round(median(shares), 5),
    }


def _judge(logs: Sequence[StreamLog], load: Load) -> dict[str, Any]:
    """Judge streams; frames that should have got a forecast and did not count as missed."""
    due, arrived, _, _ = _gather(logs, load.begin)
    failures = [failure for log in logs for failure in log.failures if failure[0] >= load.begin]
    failed, known = np.array(failures, dtype=np.float64).reshape(-1, 2).T
    paused = find_overlaps(due, arrived, load.pauses)
    failed_paused = find_overlaps(failed, known, load.pauses)
    latency_ms = (arrived - due) * 1e3
    return {
        **_judge_times(latency_ms, len(failed)),
        "without_pauses": {
            "excluded": int(paused.sum() + failed_paused.sum()),
            **_judge_times(latency_ms[~paused], int((~failed_paused).sum())),
        },
    }


def _judge_times(latency_ms: Times, failed: int) -> dict[str, Any]:
    in_time = int((latency_ms <= DEADLINE_MS).sum())
    due = len(latency_ms) + failed
    return {
        "latency_ms": summarize(latency_ms).as_json(),
        "within_33_ms": round(in_time / due, 5) if due else None,
        "due": due,
        "misses": due - in_time,
    }


def _gather(logs: Sequence[StreamLog], begin: float) -> Sequence[Times]:
    """Collect the answers to frames that were due after the warm-up."""
    answers = [answer for log in logs for answer in log.answers if answer[0] >= begin]
    return list(np.array(answers, dtype=np.float64).reshape(-1, 4).T)


def _count_frames(load: Load) -> dict[str, Any]:
    logs = load.streams
    refused: dict[str, int] = {}
    for log in logs:
        for code, count in log.refused.items():
            refused[code] = refused.get(code, 0) + count

    def add(count: Callable[[StreamLog], int]) -> int:
        return sum(count(log) for log in logs)

    return {
        "sent": add(lambda log: log.sent),
        "answered": add(lambda log: len(log.answers)),
        "measured": sum(answer[0] >= load.begin for log in logs for answer in log.answers),
        "waiting": add(lambda log: log.covered),
        "skipped": add(lambda log: log.skipped),
        "errors": refused,
        "unanswered": add(lambda log: log.lost),
        "left_behind": add(lambda log: log.left),
    }


def _describe_clients(logs: Sequence[StreamLog]) -> dict[str, Any]:
    """Tell what happened to the clients besides."""
    opened_ms = [1e3 * seconds for log in logs for seconds in log.opened_s]
    return {
        "version_changes": sum(log.swaps for log in logs),
        "came_back": len(opened_ms),
        "opening_ms": summarize(opened_ms).as_json(),
    }


def _describe_server(load: Load) -> dict[str, Any]:
    _, _, queue, compute = _gather(load.streams, load.begin)
    return {"queue": summarize(queue).as_json(), "compute": summarize(compute).as_json()}


def _describe_usage(load: Load) -> dict[str, Any] | None:
    """Give the cost of each forecast that came between the two samples."""
    if load.usage is None:
        return None
    begin, end = load.usage
    count = sum(begin.at <= one[1] <= end.at for log in load.streams for one in log.answers)
    return describe_usage(begin, end, forecasts=count)


def _describe_host(load: Load) -> dict[str, Any]:
    pauses = [pause.seconds * 1e3 for pause in load.pauses]
    late_ms = np.concatenate([np.array(log.late_s) for log in load.streams]) * 1e3
    return {
        "pause_over_ms": PAUSE_S * 1e3,
        "pauses": len(pauses),
        "paused_ms": round(sum(pauses), 1),
        "longest_ms": round(max(pauses, default=0.0), 1),
        "sent_late_ms": summarize(late_ms).as_json(),
    }
