"""The commands that call a service, as users run them."""

import json
import signal
import subprocess
import sys

import pytest

from app.commands.own_server import run_own_server
from app.settings import CLIENT_KEY_VARIABLE, make_environment
from models.runtime.fused import PROCESSORS
from models.runtime.pack import KINDS
from models.runtime.stacked import find_device
from tests.flows.conftest import add_key, call


def start(*arguments: str, key: str | None = None) -> "subprocess.Popen[str]":
    environment = make_environment(data_dir="a-folder-that-is-not-there")
    if key is not None:
        environment[CLIENT_KEY_VARIABLE] = key
    return subprocess.Popen(
        [sys.executable, "-W", "error", "-m", "app.cli", *arguments],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def run(*arguments: str, key: str | None = None, status: int = 0) -> tuple[str, str]:
    process = start(*arguments, key=key)
    told, complained = process.communicate(timeout=100)
    assert process.returncode == status, complained
    assert "Traceback" not in complained
    return told, complained


@pytest.mark.parametrize("form", ["msgpack", "json"])
def test_demo_shows_how_well_different_people_are_foreseen(served, form) -> None:
    arguments = ["demo", "--users", "2", "--url", served.url, "--seconds", "4", "--format", form]
    figures = json.loads(run(*arguments, "--json", key=served.key)[0])
    assert [person["user"] for person in figures["people"]] == ["demo-1", "demo-2"]
    for person in figures["people"]:
        assert 60 < person["sent"] <= 121
        assert person["answered"] > 0
        assert person["answered"] + person["skipped"] <= person["sent"] - 14
        assert person["errors"] == person["reconnects"] == 0
        assert person["latency_ms"]["p50"] > 0
        assert person["version"]["kind"] == "base"
    first, second = (person["error_cm"]["0.1"] for person in figures["people"])
    assert first["forecast_cm"] > 0
    assert first["zero_velocity_cm"] != second["zero_velocity_cm"]


def test_demo_leaves_cleanly_when_interrupted(served) -> None:
    process = start("demo", "--users", "1", "--url", served.url, "--key", served.key)
    for line in process.stdout:
        if "p50" in line:
            break
    process.send_signal(signal.SIGINT)
    told, complained = process.communicate(timeout=20)
    assert process.returncode == 0, complained
    assert complained == ""
    assert "At the end:" in told
    assert "demo-1" in told


def test_demo_says_in_one_line_what_is_missing(served) -> None:
    predict = add_key(served, "predict")
    stranger = "kc_" + "0" * 32 + "_" + "a" * 43
    cases = [
        (["--url", served.url], None, 2, "kinecast keys create"),
        (["--url", "somewhere"], predict, 2, "http://"),
        (["--url", "http://127.0.0.1:9"], predict, 1, "Nobody answers"),
        (["--url", served.url], stranger, 1, "unauthorized"),
        (["--url", served.url, "--users", "9"], predict, 1, "admin key"),
    ]
    for arguments, key, status, words in cases:
        _, complained = run("demo", "--seconds", "5", *arguments, key=key, status=status)
        assert len(complained.strip().splitlines()) == 1, complained
        assert words in complained


def test_demo_comes_back_when_the_service_restarts(tmp_path) -> None:
    with run_own_server(tmp_path) as server:
        url, key = server.url, server.key
        demo = start("demo", "--users", "1", "--url", url, "--json", "--seconds", "60", key=key)
        read_until(demo, "info")
    read_until(demo, "lost")
    with run_own_server(tmp_path, key=key, port=url.rpartition(":")[2]):
        read_until(demo, "info")
        demo.send_signal(signal.SIGINT)
        told, complained = demo.communicate(timeout=60)
    (person,) = json.loads(told)["people"]
    assert demo.returncode == 0, complained
    assert person["reconnects"] >= 1


def read_until(process: "subprocess.Popen[str]", word: str) -> None:
    """Read what it complains until a word comes."""
    assert any(word in line for line in process.stderr), f"{word} never came"


def test_bench_stream_accounts_for_every_frame() -> None:
    arguments = ["bench", "stream", "--users", "2", "--seconds", "2", "--repeats", "1", "--json"]
    report = json.loads(run(*arguments)[0])
    (measured,) = report["runs"]
    frames = measured["frames"]
    assert frames["sent"] == 2 * 90
    refused = sum(frames["errors"].values())
    counted = frames["answered"] + frames["waiting"] + frames["skipped"] + refused
    assert counted + frames["unanswered"] == frames["sent"]
    assert frames["unanswered"] == 0
    assert measured["latency_ms"]["p50"] > measured["server_ms"]["compute"]["p50"] > 0
    assert 0 <= measured["within_33_ms"] <= 1
    usage = measured["usage"]
    assert 0 < usage["generator"]["us_per_forecast"] < usage["server"]["us_per_forecast"]
    assert usage["server_memory_mib"]["end"] > 50
    assert measured["fairness"]["worst_user_answered"] <= 1
    clean = measured["without_pauses"]
    assert clean["due"] + clean["excluded"] == measured["due"] <= frames["sent"]
    assert clean["latency_ms"]["count"] <= measured["latency_ms"]["count"] == frames["measured"]


def test_bench_stream_gives_a_curve() -> None:
    arguments = ["--users", "3,1", "--seconds", "1", "--repeats", "1", "--base"]
    report = json.loads(run("bench", "stream", *arguments, "--json")[0])
    assert [row["users"] for row in report["curve"]] == [1, 3]
    assert [load["runs"][0]["frames"]["sent"] for load in report["loads"]] == [60, 180]
    assert report["largest"]["users"] in {None, 1, 3}
    assert report["decoders"] == "base"
    _, complained = run("bench", "stream", "--users", "0", status=2)
    assert "1,8,32" in complained


def test_bench_stream_goes_on_while_much_else_happens() -> None:
    arguments = ["--users", "4", "--seconds", "5", "--repeats", "1", "--json"]
    told, _ = run("bench", "stream", *arguments, "--with", "swaps,churn,slow,finetune")
    report = json.loads(told)
    (measured,) = report["runs"]
    assert report["with"] == ["churn", "finetune", "slow", "swaps"]
    assert measured["disturbances"]["promotions"] >= 1
    assert measured["disturbances"]["jobs_begun"] >= 1
    assert measured["clients"]["version_changes"] >= 1
    assert measured["clients"]["came_back"] >= 1
    assert measured["slow_readers"]["streams"] == 1
    assert measured["slow_readers"]["latency_ms"]["max"] > 500
    assert measured["frames"]["sent"] < 4 * 180
    for wrong in (["--with", "storms"], ["--with", "swaps", "--base"]):
        run("bench", "stream", *wrong, status=2)


def test_bench_stream_measures_a_running_service_and_leaves_no_users(served) -> None:
    arguments = ["--url", served.url, "--seconds", "1", "--repeats", "2", "--format", "json"]
    told, _ = run("bench", "stream", *arguments, key=served.key)
    assert "in time" in told
    assert "1 stream at 30 Hz" in told
    users = call(served, "GET", "/v1/users").json()["items"]
    assert not [user for user in users if user["id"].startswith("bench-")]


def test_bench_finetune_times_whole_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = ["--users", "1", "--clips", "6", "--seconds", "2.5", "--json"]
    monkeypatch.setenv("KINECAST_FINETUNE_STEPS", "3")
    told, _ = run("bench", "finetune", *arguments)
    report = json.loads(told)
    assert report["steps"] == 9
    assert sum(report["verdicts"].values()) == 1
    assert report["seconds"]["count"] == 1
    assert report["seconds"]["p50"] > 0
    assert report["bytes_per_version"] > 5e5


def test_bench_memory_fills_the_cache_step_by_step() -> None:
    arguments = ["--decoders", "4,40", "--active", "4", "--rounds", "2", "--users", "3", "--json"]
    report = json.loads(run("bench", "memory", *arguments)[0])
    assert [row["decoders"] for row in report["rows"]] == [4, 40]
    assert all(row["us_per_forecast"]["count"] == 8 for row in report["rows"])
    assert 0.3 < report["mib_per_decoder"] < 5
    assert 0 < report["slowdown"] < 10
    assert report["connected_users"]["service_mib"] > 50
    for wrong in (["--decoders", "4"], ["--users", "1"]):
        run("bench", "memory", *wrong, status=2)


def test_bench_start_times_starts_and_first_forecasts() -> None:
    report = json.loads(run("bench", "start", "--starts", "1", "--users", "2", "--json")[0])
    assert report["ready_s"]["count"] == 1
    assert report["ready_s"]["p50"] > 0.2
    for name in ("first_forecast_ms", "second_forecast_ms", "first_of_stream_ms"):
        assert report[name]["count"] == 2
        assert report[name]["p50"] > 0
    told, _ = run("bench", "start", "--starts", "1", "--users", "1")
    assert "cold user over HTTP" in told


def test_bench_forecast_compares_every_way_and_the_floor() -> None:
    told, _ = run("bench", "forecast", "--users", "1,4", "--repeats", "5", "--json")
    report = json.loads(told)
    kernels = [f"{name} {kind}" for name in PROCESSORS for kind in KINDS]
    of_kernel = [f"{name} {kind}" for name in PROCESSORS for kind in (*KINDS, "served")]
    ways = ["eager", "torch", f"stacked {find_device('auto') or 'cpu'}", *of_kernel]
    rows = report["rows"]
    assert [(row["users"], row["way"]) for row in rows] == [(n, w) for n in (1, 4) for w in ways]
    assert all(row["calls"] == 5 for row in rows)
    assert all(0 < row["us_per_forecast"]["median"] < 1e6 for row in rows)
    for row in rows:
        is_kernel = row["way"] in kernels
        assert (row["floor_us"] is not None) == is_kernel
        assert not is_kernel or row["us_per_forecast"]["median"] > 0.5 * row["floor_us"] > 0
    assert (report["floor"] is not None) == bool(kernels)
    _, complained = run("bench", "forecast", "--users", "none", status=2)
    assert "1,8,32" in complained
