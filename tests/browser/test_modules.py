"""The modules of the viewer that need no browser, under node's own test runner."""

import io
import json
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import scipy.io

from tests.personal_support import record_frames

TESTS = Path(__file__).with_name("js") / "viewer.test.mjs"
OLDEST = 20


def find_node() -> str:
    node = shutil.which("node")
    if node is None:
        pytest.skip("no node is installed")
    version = subprocess.run([node, "--version"], capture_output=True, text=True, check=True).stdout
    if int(version.lstrip("v").split(".")[0]) < OLDEST:
        pytest.skip(f"node {version.strip()} is older than {OLDEST}")
    return node


def write_fixtures(folder: Path) -> None:
    """Recordings as other programs write them."""
    poses = record_frames(1.0).joints.astype(np.float32)
    (folder / "expected.json").write_text(json.dumps(poses.reshape(len(poses), -1).tolist()))
    skeleton = {"other": np.eye(3), "d_skel": poses.transpose(1, 2, 0).astype(float)}
    scipy.io.savemat(folder / "packed.mat", skeleton, do_compression=True)
    scipy.io.savemat(folder / "plain.mat", skeleton | {"d_skel": poses.transpose(1, 2, 0)})
    scipy.io.savemat(folder / "foreign.mat", {"d_skel": np.zeros((4, 3, 2))})
    arrays = {
        "frames": poses,
        "lengths": np.array([20, 10]),
        "subject": np.array(["1", "1"]),
        "action": np.array(["wave", "walk"]),
        "trial": np.array(["1", "1"]),
        "rate_hz": 30.0,
    }
    for name, save in (("packed.npz", np.savez_compressed), ("plain.npz", np.savez)):
        out = io.BytesIO()
        save(out, **arrays)
        (folder / name).write_bytes(out.getvalue())
    np.savez(folder / "fortran.npz", **arrays | {"frames": np.asfortranarray(poses)})
    np.savez(folder / "half.npz", **arrays | {"frames": poses.astype(np.float16)})


def test_the_modules_pass_their_own_tests(tmp_path):
    node = find_node()
    write_fixtures(tmp_path)
    ran = subprocess.run(
        [node, "--test", "--test-reporter=tap", str(TESTS)],
        capture_output=True,
        text=True,
        env=os.environ | {"VIEWER_FIXTURES": str(tmp_path), "NODE_NO_WARNINGS": "1"},
        timeout=100,
        check=False,
    )
    assert ran.returncode == 0, ran.stdout[-6000:] + ran.stderr[-2000:]
    assert "# skipped 0" in ran.stdout
