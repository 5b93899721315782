"""How a training process steps back behind forecasting."""

import subprocess
import sys

import pytest

from app.worker.trainer import AUTOGROUP

STEP_BACK = "import os; from app.worker.trainer import step_back; step_back(7); print(os.nice(0))"


def run(script: str, *, own_session: bool) -> str:
    """Give what a fresh process prints."""
    command = [sys.executable, "-c", script]
    done = subprocess.run(
        command, check=True, capture_output=True, text=True, start_new_session=own_session
    )
    return done.stdout


def test_it_is_nice() -> None:
    assert int(run(STEP_BACK, own_session=True)) >= 7


@pytest.mark.skipif(not AUTOGROUP.exists(), reason="this kernel has no autogroups")
@pytest.mark.parametrize("own_session", [True, False])
def test_its_session_steps_back_only_where_it_is_its_own(own_session: bool) -> None:
    before, after = (
        run(f"{script}; print(open('{AUTOGROUP}').read())", own_session=own_session)
        for script in ("pass", STEP_BACK)
    )
    assert after.strip().endswith("nice 7") is own_session
    assert not before.strip().endswith("nice 7")
