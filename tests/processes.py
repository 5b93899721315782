"""The command as a user runs it: in a process of its own, where every warning is an error."""

import subprocess
import sys
from collections.abc import Mapping

from tests.conftest import ROOT


def command(*arguments: str) -> list[str]:
    return [sys.executable, "-W", "error", "-m", "app.cli", *arguments]


def run(
    *arguments: str, env: Mapping[str, str], timeout_s: float = 100
) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        command(*arguments),
        cwd=ROOT,
        env=dict(env),
        capture_output=True,
        text=True,
        timeout=timeout_s,
        check=False,
    )
