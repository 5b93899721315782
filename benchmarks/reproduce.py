"""Train the shipped base from scratch and compare it; kill a shorter run and resume it.

    python -m benchmarks.reproduce --data ../shared/data/utd-mhad --mix ../shared/data/more-people

Prints JSON: seconds of the whole run and the largest difference of any cell of its error table from
the shipped model's; and whether a run of `--kill-steps` that was killed with SIGKILL and resumed
ended in the very weights of an unbroken run of as many steps.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import torch

from models.checkpoint import SHIPPED, load_checkpoint
from models.data.clips import load_clips
from models.data.splits import TEST_SUBJECTS, TEST_TRIALS
from models.training.evaluate import evaluate

DEADLINE_S = 3600.0


def start(arguments: argparse.Namespace, out: Path, steps: int | None) -> "subprocess.Popen[bytes]":
    command = [sys.executable, "-m", "app.cli", "pretrain", "--subjects", "1,3,5,7"]
    command += ["--data", str(arguments.data), "--mix", str(arguments.mix), "--out", str(out)]
    if steps:
        command += ["--steps", str(steps)]
    return subprocess.Popen(command)


def run_unbroken(arguments: argparse.Namespace, out: Path, steps: int | None) -> float:
    began = time.monotonic()
    process = start(arguments, out, steps)
    if process.wait(DEADLINE_S):
        raise SystemExit(f"pretraining ended with status {process.returncode}")
    return time.monotonic() - began


def run_with_a_kill(arguments: argparse.Namespace, out: Path) -> None:
    state = out.with_suffix(".state")
    process = start(arguments, out, arguments.kill_steps)
    deadline = time.monotonic() + DEADLINE_S
    while not state.exists():
        if process.poll() is not None or time.monotonic() > deadline:
            raise SystemExit("the run ended before it could be killed")
        time.sleep(0.05)
    time.sleep(arguments.kill_after_s)
    os.kill(process.pid, signal.SIGKILL)
    process.wait(30)
    run_unbroken(arguments, out, arguments.kill_steps)


def is_same(one: Path, other: Path) -> bool:
    a = load_checkpoint(one).predictor.state_dict()
    b = load_checkpoint(other).predictor.state_dict()
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def compare_tables(arguments: argparse.Namespace, out: Path) -> dict[str, object]:
    clips = load_clips(arguments.data, subjects=TEST_SUBJECTS, trials=TEST_TRIALS)
    found = {}
    for name, path in (("shipped", SHIPPED), ("again", out)):
        rows = evaluate({"base": load_checkpoint(path).predictor}, clips, by_subject=True)
        table = {row.subject: row.scores.mse_cm2 for row in rows if row.method == "base"}
        found[name] = {subject: [round(v, 3) for v in cells] for subject, cells in table.items()}
    ratios = [
        again / shipped
        for subject in found["shipped"]
        for shipped, again in zip(found["shipped"][subject], found["again"][subject], strict=True)
    ]
    worst = max(abs(ratio - 1) for ratio in ratios)
    return {"mse_cm2": found, "largest_difference": round(worst, 5)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--mix", type=Path, required=True)
    parser.add_argument("--out", type=Path, default=Path("var/reproduce"))
    parser.add_argument("--steps", type=int, help="fewer steps, for a trial of this script")
    parser.add_argument("--kill-steps", type=int, default=400, help="steps of the killed run")
    parser.add_argument("--kill-after-s", type=float, default=5.0, help="after the first save")
    arguments = parser.parse_args()
    for left in arguments.out.glob("*.state"):
        left.unlink()
    names = ("whole", "unbroken", "broken")
    whole, unbroken, broken = (arguments.out / f"{name}.safetensors" for name in names)
    run_unbroken(arguments, unbroken, arguments.kill_steps)
    run_with_a_kill(arguments, broken)
    seconds = run_unbroken(arguments, whole, arguments.steps)
    report = {"seconds": round(seconds, 1), "resumed_equals_unbroken": is_same(unbroken, broken)}
    print(json.dumps(report | compare_tables(arguments, whole), indent=1))


if __name__ == "__main__":
    main()
