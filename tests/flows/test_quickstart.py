"""The quickstart's own blocks, run as they stand, against a service on another port."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from models.skeleton import KINECT_V1
from tests.conftest import ROOT
from tests.contract.pages import read_blocks, read_page
from tests.live_support import serve
from tests.support import make_settings

ACTIVATE = "source .venv/bin/activate\n"
INSTALL = "pip install ./clients/python\n"
DEFAULT = "127.0.0.1:8000"


@pytest.mark.timeout(240)
@pytest.mark.skipif(shutil.which("curl") is None, reason="the quickstart calls curl")
def test_quickstart_leads_to_forecasts_by_the_client_and_over_both_routes(tmp_path: Path) -> None:
    page = read_page("docs/quickstart.md")
    script = "".join(read_blocks(page, "sh"))
    programs = dict(zip(("robot.py", "stream.py"), read_blocks(page, "python"), strict=True))
    assert ACTIVATE in script
    assert INSTALL in script
    assert all(f"python {name}\n" in script for name in programs)
    assert all(DEFAULT in text for text in (script, *programs.values()))
    with serve(make_settings(tmp_path / "data")) as server:
        address = f"127.0.0.1:{server.port}"
        for name, program in programs.items():
            (tmp_path / name).write_text(program.replace(DEFAULT, address))
        steps = script.replace(ACTIVATE, "").replace(INSTALL, "").replace(DEFAULT, address)
        shown = run_in_shell(steps, tmp_path)
    assert shown.count("in half a second: ") > 60  # of 136; a busy machine skips some
    assert shown.count("the right hand is at [") == 15
    assert KINECT_V1.joints[11] == "right_hand"  # what the page's snippet says
    assert "\ninfo ['uncalibrated'] base\n" in shown  # the stand-in for the model has no radius
    assert "'reason': 'warm_up'" in shown
    forecasts = re.findall(r"^(\d+): .* m, \d+ ms old$", shown, re.MULTILINE)
    assert forecasts[0] == "14"  # the fifteenth frame
    assert len(forecasts) > 60
    answer = json.loads((tmp_path / "answer.json").read_text())
    explained = page.partition("## What the answer means")[2]
    assert [name for name in answer if f"`{name}`" not in explained] == []


def run_in_shell(steps: str, folder: Path) -> str:
    kept = {name: value for name, value in os.environ.items() if not name.startswith("KINECAST_")}
    env = kept | {
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'clients' / 'python' / 'src'}",
        "KINECAST_DATA_DIR": str(folder / "data"),
        "OMP_NUM_THREADS": "1",
    }
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", steps],
        cwd=folder,
        env=env,
        capture_output=True,
        text=True,
        timeout=200,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout
