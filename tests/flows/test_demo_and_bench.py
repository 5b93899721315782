"""The commands that call a service, as users run them."""

import json
import signal
import subprocess
import sys

import pytest

from app.commands.own_server import run_own_server
from app.settings import CLIENT_KEY_VARIABLE, make_environment
from models.runtime.fused import PROCESSORS
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
    assert measured["without_pauses"]["latency_ms"]["count"] == (
        measured["latency_ms"]["count"] - measured["without_pauses"]["excluded"]
    )


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


def test_bench_forecast_compares_every_way_and_the_floor() -> None:
    told, _ = run("bench", "forecast", "--users", "1,4", "--repeats", "5", "--json")
    report = json.loads(told)
    kernels = [f"{name} {kind}" for name in PROCESSORS for kind in ("float32", "float16")]
    ways = ["eager", "torch", *kernels]
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
