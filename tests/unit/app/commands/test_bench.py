"""The arithmetic of the benchmarks."""

import math
import re
import time

import numpy as np
import pytest

from app.commands.bench.generator import Load, StreamLog
from app.commands.bench.probe import IdleProbe, Pause, find_overlaps
from app.commands.bench.stream import describe_load
from app.commands.figures import summarize


def test_summary_has_median_tail_and_maximum() -> None:
    told = summarize(np.arange(1001.0)).as_json()
    assert told == {"p50": 500.0, "p99": 990.0, "p99_9": 999.0, "max": 1000.0, "count": 1001}


def test_summary_of_nothing_is_no_number() -> None:
    assert math.isnan(summarize([]).median)
    assert summarize([]).as_json()["p99"] is None


def test_intervals_that_meet_a_pause_are_found() -> None:
    begins = np.array([0.0, 1.0, 2.0, 3.0, 9.0])
    found = find_overlaps(begins, begins + 0.5, [Pause(1.4, 2.1), Pause(3.1, 3.2)])
    assert found.tolist() == [False, True, True, True, False]
    assert not find_overlaps(begins, begins + 0.5, []).any()


def test_probe_notes_a_pause_of_this_process() -> None:
    probe = IdleProbe()
    with probe.running():
        time.sleep(0.02)
        begin = time.monotonic()
        re.match(r"^(a|aa)+$", "a" * 27 + "!")  # keeps the interpreter to itself
        end = time.monotonic()
        time.sleep(0.02)
    met = [pause for pause in probe.pauses if pause.begin < end and pause.end > begin]
    assert max(pause.seconds for pause in met) > 0.5 * (end - begin)


def make_load() -> Load:
    """100 answers after 10 ms, of which 10 met a pause and took 50 ms; and some that failed."""
    log = StreamLog(sent=130, late_s=[0.001] * 130, skipped=3, covered=14, lost=1)
    log.refused = {"stale_frame": 2}
    warm_up = [(-1.0 + i / 30, -1.0 + i / 30 + 0.2, 1.0, 5.0) for i in range(10)]
    dues = [i / 30 for i in range(100)]
    log.answers = warm_up + [
        (due, due + (0.05 if i < 10 else 0.01), 1.0, 5.0) for i, due in enumerate(dues)
    ]
    return Load((log,), (Pause(-0.001, 10 / 30 - 0.01),), 0.0)


def test_report_counts_what_got_no_forecast_as_missed() -> None:
    told = describe_load(make_load())
    assert told["latency_ms"]["count"] == 100
    assert told["latency_ms"]["p50"] == 10.0
    assert told["misses"] == 10 + 3 + 2 + 1
    assert told["within_33_ms"] == pytest.approx(90 / 106, abs=1e-5)
    assert told["frames"]["unanswered"] == 1
    assert told["server_ms"]["compute"]["p50"] == 5.0


def test_report_without_pauses_leaves_out_what_met_one() -> None:
    clean = describe_load(make_load())["without_pauses"]
    assert clean["excluded"] == 10
    assert clean["latency_ms"]["max"] == 10.0
    assert clean["misses"] == 6


def test_report_of_a_run_without_answers_has_no_figures() -> None:
    told = describe_load(Load((StreamLog(sent=5, late_s=[0.0] * 5, lost=5),), (), 0.0))
    assert told["latency_ms"]["p50"] is None
    assert told["misses"] == 5
    assert told["within_33_ms"] == 0.0
