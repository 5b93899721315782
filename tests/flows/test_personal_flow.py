"""From recordings to a version, as an operator does it: processes, a port, files."""

import json
import os
import re
import signal
import subprocess
import time
from contextlib import contextmanager

import httpx
import numpy as np
import pytest

from models.checkpoint import save_checkpoint
from models.predictor import Predictor
from tests.conftest import ROOT
from tests.nets import TINY
from tests.personal_support import record_frames
from tests.processes import command, run
from tests.support import ADMIN_KEY

HEADERS = {"Authorization": f"Bearer {ADMIN_KEY}"}


@pytest.fixture
def environment(tmp_path):
    model = tmp_path / "small.safetensors"
    save_checkpoint(model, Predictor(config=TINY), {})
    kept = {k: v for k, v in os.environ.items() if not k.startswith("KINECAST_")}
    return kept | {
        "KINECAST_MODEL": str(model),
        "KINECAST_DATA_DIR": str(tmp_path / "var"),
        "KINECAST_ADMIN_KEY": ADMIN_KEY,
        "KINECAST_WORKER_POLL_S": "0.2",
        "COLUMNS": "200",
    }


@contextmanager
def serving(environment, *arguments):
    process = subprocess.Popen(
        command("serve", "--port", "0", *arguments),
        cwd=ROOT,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    try:
        line = process.stdout.readline()
        yield re.search(r"http://\S+", line)[0], process
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGTERM)
        process.wait(30)
        process.stdout.close()


def write_recordings(path):
    people = [record_frames(2.5, seed=1, action=a) for a in ("wave", "walk", "punch") for _ in "ab"]
    np.savez(
        path,
        frames=np.concatenate([frames.joints for frames in people]),
        lengths=np.array([len(frames) for frames in people]),
        subject=np.array(["4"] * len(people)),
        action=np.array([str(i) for i in range(len(people))]),
        trial=np.array(["1"] * len(people)),
        rate_hz=np.float64(30.0),
    )


def wait_for(check):
    for _ in range(300):
        found = check()
        if found:
            return found
        time.sleep(0.1)
    raise AssertionError("it did not happen")


def test_imported_recordings_become_a_judged_version(tmp_path, environment):
    write_recordings(tmp_path / "own.npz")
    arguments = ("import", "--user", "ada", "--data", str(tmp_path / "own.npz"), "--json")
    with serving(environment | {"KINECAST_FINETUNE_STEPS": "60"}) as (url, _):
        done = run(*arguments, "--url", url, "--wait", env=environment)
        assert done.returncode == 0, done.stderr
        (answer,) = json.loads(done.stdout)
        assert (answer["trial"]["clips"], answer["trial"]["clips_unused"]) == (6, 0)
        assert answer["job"]["state"] in {"succeeded", "rejected"}
        assert answer["job"]["version"] == 1
        again = run(*arguments, "--url", url, env=environment)
        assert json.loads(again.stdout)[0]["trial"]["id"] == answer["trial"]["id"]
        version = httpx.get(f"{url}/v1/users/ada/versions/1", headers=HEADERS).json()
        assert version["metrics"]["frames"] == [2, 4, 8, 10, 13, 15]
        assert version["metrics"]["clips"] == 6
        assert version["metrics"]["unseen"]["clips"] >= 2
        base = httpx.get(f"{url}/v1/users/ada/versions/0/weights", headers=HEADERS)
        assert base.headers["etag"] == f'"{version["base_sha256"]}"'


def test_wrong_imports_are_one_clear_line(tmp_path, environment):
    for arguments, word in (
        (("--data", str(tmp_path / "nothing")), "no such file"),
        (("--data", str(tmp_path / "own.npz"), "--subject", "5"), "no clips of subject 5"),
    ):
        write_recordings(tmp_path / "own.npz")
        done = run("import", "--user", "ada", *arguments, env=environment)
        assert done.returncode == 2
        assert word in done.stderr
        assert "Traceback" not in done.stderr


def find_children(pid):
    listed = subprocess.run(
        ["ps", "-o", "pid=", "--ppid", str(pid)], capture_output=True, text=True, check=False
    )
    return [int(line) for line in listed.stdout.split()]


def is_alive(pid):
    try:
        with open(f"/proc/{pid}/stat") as file:  # noqa: PTH123 - one line of the kernel's
            return file.read().split()[2] != "Z"
    except OSError:
        return False


def test_worker_of_a_service_comes_back_and_goes_with_it(environment):
    with serving(environment) as (_, process):
        (worker,) = wait_for(lambda: find_children(process.pid))
        os.kill(worker, signal.SIGKILL)
        heir = wait_for(lambda: [p for p in find_children(process.pid) if p != worker])
        process.kill()
        process.wait()
        wait_for(lambda: not is_alive(heir[0]))


def test_service_can_do_without_a_worker(environment):
    with serving(environment, "--no-worker") as (url, process):
        assert httpx.get(f"{url}/readyz").status_code == 200
        assert find_children(process.pid) == []
