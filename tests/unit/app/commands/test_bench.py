"""The arithmetic of the benchmarks."""

import io
import math
import os
import re
import time

import numpy as np
import pytest
from rich.console import Console

from app.commands.bench.accounts import StreamLog
from app.commands.bench.command import read_numbers
from app.commands.bench.generator import Load
from app.commands.bench.probe import IdleProbe, Pause, find_overlaps
from app.commands.bench.report import describe_load
from app.commands.bench.scenarios import Scenario, choose_slow, read_scenarios
from app.commands.bench.stream import describe_curve, describe_runs
from app.commands.bench.tables import tabulate_memory, tabulate_stream
from app.commands.bench.usage import Sample, describe_usage, read_cpu_s, read_resident_mib
from app.commands.figures import summarize, take_median


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
    log.failures = [(-0.5, -0.4), (0.1, 0.2)] + [(1.0 + i, 1.1 + i) for i in range(5)]
    warm_up = [(-1.0 + i / 30, -1.0 + i / 30 + 0.2, 1.0, 5.0) for i in range(10)]
    dues = [i / 30 for i in range(100)]
    log.answers = warm_up + [
        (due, due + (0.05 if i < 10 else 0.01), 1.0, 5.0) for i, due in enumerate(dues)
    ]
    samples = Sample(0.0, 1.0, 2.0, 300.0), Sample(4.0, 1.2, 4.0, 301.0)
    return Load((log,), (Pause(-0.001, 10 / 30 - 0.01),), 0.0, samples)


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
    assert clean["excluded"] == 10 + 1
    assert clean["latency_ms"]["max"] == 10.0
    assert clean["misses"] == 5


def test_report_of_a_run_without_answers_has_no_figures() -> None:
    log = StreamLog(sent=5, late_s=[0.0] * 5, lost=5, failures=[(0.1 * i, 2.0) for i in range(5)])
    told = describe_load(Load((log,), (), 0.0))
    assert told["latency_ms"]["p50"] is None
    assert told["misses"] == told["due"] == 5
    assert told["within_33_ms"] == 0.0
    assert told["fairness"]["worst_user_answered"] == 0.0
    assert told["usage"] is None


def test_report_tells_slow_readers_apart() -> None:
    load = make_load()
    slow = StreamLog(slow=True, sent=1, late_s=[0.0], answers=[(1.0, 2.0, 1.0, 5.0)])
    told = describe_load(Load((*load.streams, slow), load.pauses, 0.0))
    assert told["latency_ms"] == describe_load(load)["latency_ms"]
    assert told["slow_readers"]["streams"] == 1
    assert told["slow_readers"]["latency_ms"]["p50"] == 1000.0
    assert told["frames"]["answered"] == 111


def test_report_has_what_a_forecast_costs() -> None:
    usage = describe_load(make_load())["usage"]
    count = 100  # of those that came within the four seconds
    assert usage["server"] == {"us_per_forecast": pytest.approx(2e6 / count), "cores": 0.5}
    assert usage["generator"]["us_per_forecast"] == pytest.approx(0.2e6 / count)
    assert usage["server_memory_mib"] == {"begin": 300.0, "end": 301.0}


def test_cost_of_a_service_that_is_not_ours_is_unknown() -> None:
    told = describe_usage(Sample(0.0, 0.0, None, None), Sample(1.0, 0.1, None, None), forecasts=0)
    assert told["server"] == {"us_per_forecast": None, "cores": None}
    assert told["generator"] == {"us_per_forecast": None, "cores": 0.1}


def test_counters_of_this_process_are_read() -> None:
    before = read_cpu_s(os.getpid())
    assert before is not None
    spent = time.process_time()
    while time.process_time() - spent < 0.1:
        pass
    assert 0.05 < (read_cpu_s(os.getpid()) or 0) - before < 5
    assert 10 < (read_resident_mib(os.getpid()) or 0) < 10_000
    assert read_cpu_s(2**30) is None
    assert read_resident_mib(2**30) is None


def test_curve_names_the_largest_load_that_is_carried() -> None:
    run = describe_load(make_load())
    fine = run | {"misses": 0, "due": 1000, "without_pauses": run["without_pauses"] | {"misses": 0}}
    better = run | {"without_pauses": run["without_pauses"] | {"misses": 0}}
    loads = [describe_runs(8, [fine]), describe_runs(16, [better]), describe_runs(32, [run, run])]
    told = describe_curve(loads)
    assert [row["users"] for row in told["curve"]] == [8, 16, 32]
    assert told["curve"][2]["misses"] == 2 * run["misses"]
    assert told["curve"][2]["p99_9_ms"] == run["latency_ms"]["p99_9"]
    assert told["largest"]["users"] == 8
    assert told["largest"]["users_without_pauses"] == 16


def test_tables_show_runs_and_curves() -> None:
    run = describe_load(make_load())
    run |= {"disturbances": {"promotions": 7}}
    log = StreamLog(slow=True, swaps=3, late_s=[0.0], answers=[(1.0, 2.0, 1.0, 5.0)])
    log.opened_s = [0.02]
    disturbed = describe_load(Load((log,), (), 0.0, make_load().usage)) | {"disturbances": {}}
    one = {"seconds": 4.0, "format": "json", "with": [], **describe_runs(1, [run, disturbed])}
    console = Console(width=200, record=True, file=io.StringIO())
    console.print(tabulate_stream(one))
    loads = [describe_runs(users, [run]) for users in (1, 8)]
    console.print(tabulate_stream({"seconds": 4.0, "with": ["slow"], **describe_curve(loads)}))
    told = console.export_text()
    assert "1 stream at 30 Hz for 4 s, json" in told
    assert "up to no users" in told
    assert "1: promotions 7" in told
    assert "2: version changes told 3 · came back 1, p99 20.0 ms · 1 slow readers" in told
    assert "with slow" in told


def test_scenarios_are_a_list() -> None:
    assert read_scenarios("") == frozenset()
    assert read_scenarios("swaps, slow") == {Scenario.SWAPS, Scenario.SLOW}
    with pytest.raises(ValueError, match="often"):
        read_scenarios("often")


def test_a_tenth_of_the_clients_reads_slowly() -> None:
    slow = frozenset({Scenario.SLOW})
    assert choose_slow(100, frozenset()) == frozenset()
    assert choose_slow(1, slow) == {0}
    assert choose_slow(40, slow) == {0, 10, 20, 30}


def test_table_of_memory_does_without_users() -> None:
    each = summarize([200.0, 300.0]).as_json()
    rows = [{"decoders": 100, "resident_mib": 400.0, "us_per_forecast": each}]
    report = {"active": 100, "rows": rows, "mib_per_decoder": 0.66, "connected_users": None}
    console = Console(width=120, record=True, file=io.StringIO())
    console.print(tabulate_memory(report))
    connected = {"users": 9, "mib_per_user": 1.5, "service_mib": 380.0}
    console.print(tabulate_memory(report | {"connected_users": connected}))
    told = " ".join(console.export_text().split())
    assert "0.66 MiB for each cached decoder" in told
    assert "1.50 MiB for each connected user" in told


def test_numbers_of_users_are_a_list() -> None:
    assert read_numbers("8", most=100) == [8]
    assert read_numbers("32,1, 8,8", most=100) == [1, 8, 32]
    for wrong in ("", "none", "0", "101"):
        with pytest.raises(SystemExit):
            read_numbers(wrong, most=100)


def test_median_leaves_out_what_is_not_known() -> None:
    assert take_median([None, 1.0, 3.0]) == 2.0
    assert take_median([None]) is None
