"""The command as a user runs it: in a process of its own, on a real port."""

import asyncio
import json
import os
import re
import signal
import socket
import stat
import subprocess
import time
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest
import websockets

from models.checkpoint import save_checkpoint
from models.predictor import Predictor
from tests.conftest import ROOT
from tests.nets import TINY
from tests.processes import command, run
from tests.support import ADMIN_KEY, watch_person


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("model") / "small.safetensors"
    save_checkpoint(path, Predictor(config=TINY), {})
    return path


def environment(model: Path, **variables: str) -> dict[str, str]:
    kept = {k: v for k, v in os.environ.items() if not k.startswith("KINECAST_")}
    return kept | {"KINECAST_MODEL": str(model), "COLUMNS": "200"} | variables


@contextmanager
def served(data_dir: Path, env: dict[str, str]):
    """A running server: its process, its address and what it said until it was ready."""
    arguments = ["serve", "--port", "0", "--data-dir", str(data_dir), "--no-worker"]
    process = subprocess.Popen(
        command(*arguments),
        cwd=ROOT,
        env=env | {"PYTHONUNBUFFERED": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    said = []
    try:
        for line in process.stdout:
            said.append(line)
            if line.strip().startswith("Stop"):
                break
        text = "".join(said)
        address = re.search(r"ready at (\S+)", text)
        assert address, text + process.stderr.read()
        yield process, address[1], text
    finally:
        if process.poll() is None:
            process.kill()
        process.communicate(timeout=30)


def test_empty_folder_to_first_forecast_and_a_clean_end(model, tmp_path):
    with served(tmp_path / "data", environment(model)) as (process, address, said):
        key_file = tmp_path / "data" / "admin-key"
        assert str(key_file) in said  # no terminal: the key is kept in a file, not in a log
        assert stat.S_IMODE(key_file.stat().st_mode) == 0o600
        key = key_file.read_text().strip()
        assert key not in said
        headers = {"Authorization": f"Bearer {key}"}
        assert "server" not in httpx.get(f"{address}/healthz").headers
        assert httpx.get(f"{address}/readyz").status_code == 200
        made = httpx.post(f"{address}/v1/users", json={"id": "ada"}, headers=headers)
        assert made.status_code == 201
        body = {"frames": watch_person().tolist()}
        answer = httpx.post(f"{address}/v1/users/ada/forecast", json=body, headers=headers)
        assert answer.status_code == 200, answer.text
        assert answer.json()["version"]["kind"] in {"base", "damped_velocity"}
        process.send_signal(signal.SIGTERM)
        _, logged = process.communicate(timeout=30)
        assert process.returncode == 0
    lines = [json.loads(line) for line in logged.splitlines()]
    assert [line["event"] for line in lines][-1] == "stopped"
    assert key not in logged
    assert "Traceback" not in logged


def test_second_start_keeps_the_data_and_is_quick(model, tmp_path):
    env = environment(model, KINECAST_ADMIN_KEY=ADMIN_KEY)
    headers = {"Authorization": f"Bearer {ADMIN_KEY}"}
    with served(tmp_path, env) as (_, address, said):
        assert "KINECAST_ADMIN_KEY" in said
        assert ADMIN_KEY not in said
        httpx.post(f"{address}/v1/users", json={"id": "ada"}, headers=headers).raise_for_status()
    started = time.monotonic()
    with served(tmp_path, env) as (_, address, _):
        assert time.monotonic() - started < 30  # 3 s on an idle machine
        assert httpx.get(f"{address}/v1/users/ada", headers=headers).status_code == 200


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_open_stream_is_told_before_the_server_goes(model, tmp_path, number):
    env = environment(model, KINECAST_ADMIN_KEY=ADMIN_KEY)
    headers = {"Authorization": f"Bearer {ADMIN_KEY}"}

    async def stream(address, process):
        url = address.replace("http", "ws") + "/v1/users/ada/stream"
        async with websockets.connect(
            url, additional_headers=headers, subprotocols=["kinecast.v1.json"], proxy=None
        ) as client:
            assert json.loads(await client.recv())["type"] == "hello"
            process.send_signal(number)
            async with asyncio.timeout(20):
                told = [json.loads(message)["type"] async for message in client]
            return told, client.close_code

    with served(tmp_path, env) as (process, address, _):
        httpx.post(f"{address}/v1/users", json={"id": "ada"}, headers=headers).raise_for_status()
        told, close_code = asyncio.run(stream(address, process))
        assert process.wait(30) == 0
    assert told[-1] == "bye"
    assert close_code == 1001


def assert_one_line(done, status, *words):
    assert done.returncode == status, done.stderr
    assert len(done.stderr.strip().splitlines()) == 1, done.stderr
    for word in words:
        assert word in done.stderr


def test_port_in_use_is_one_clear_line(model, tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        done = run(
            "serve", "--port", port, "--data-dir", str(tmp_path / "data"), env=environment(model)
        )
    assert_one_line(done, 2, port, "Address already in use")
    assert not (tmp_path / "data").exists()


def test_missing_model_is_one_clear_line(tmp_path):
    env = environment(tmp_path / "none.safetensors")
    done = run("serve", "--port", "0", "--data-dir", str(tmp_path), env=env)
    assert_one_line(done, 2, "none.safetensors")


def test_misspelt_setting_is_one_clear_line(model, tmp_path):
    env = environment(model, KINECAST_DATADIR="x")
    assert_one_line(run("serve", env=env), 2, "KINECAST_DATADIR", "KINECAST_DATA_DIR")


def test_database_out_of_reach_is_one_clear_line(model, tmp_path):
    env = environment(model, KINECAST_DATABASE_URL="postgresql://nobody@127.0.0.1:1/none")
    done = run("serve", "--port", "0", "--data-dir", str(tmp_path), env=env)
    assert_one_line(done, 1, "database cannot be reached")


def test_key_that_cannot_be_kept_is_one_clear_line_and_none_is_made(model, tmp_path):
    (tmp_path / "admin-key").mkdir()
    env = environment(model)
    done = run("serve", "--port", "0", "--data-dir", str(tmp_path), env=env)
    assert_one_line(done, 1, "secret", str(tmp_path), "directory")
    assert (
        json.loads(run("keys", "list", "--json", "--data-dir", str(tmp_path), env=env).stdout) == []
    )
