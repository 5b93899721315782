"""What the personal flow gives for real people, through a running service with default settings.

Run it with `make personal` (needs the UTD-MHAD recordings; about half an hour). Parts:

- `accept`: trial 1 of subjects 2, 4, 6 is uploaded while another stream runs; how long until the
  version answers, and the errors on trials 2 to 4, by requests, beside those computed here with the
  weights of the version that each answer names.
- `half`: half of the actions of trial 1; the errors on these actions and on the others.
- `growth`: trial 1, then 1+2, then 1+2+3, tested on trial 4.
- `junk`: what must not win, as a first trial and after a good one.
"""

import argparse
import asyncio
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from app.commands.client.rest import Api
from app.commands.import_ import FINAL, make_body
from app.commands.own_server import OwnServer, run_own_server
from app.settings import make_environment
from benchmarks.junk import JUNK
from models.baselines import Forecaster
from models.checkpoint import SHIPPED, Checkpoint, load_checkpoint, load_personal
from models.data.clips import Clip, load_clips
from models.data.splits import select
from models.data.windows import Windows, cut_windows
from models.metrics import FRAMES, Scores, evaluate_forecasts
from models.spec import MotionSpec
from models.training.evaluate import score_forecaster

SPEC = MotionSpec()
SUBJECTS = ("2", "4", "6")
AT_ONCE = 4
STREAM_S = 45


@dataclass(frozen=True)
class Bench:
    """What every part needs: the service, the recordings, and the base that both know."""

    server: OwnServer
    clips: Sequence[Clip]
    base: Checkpoint

    def select(self, subject: str, *trials: str) -> list[Clip]:
        """Give the clips of a subject's trials."""
        return select(self.clips, subjects=[subject], trials=trials)

    async def train(self, user: str, clips: Sequence[Clip], *, label: str = "") -> dict[str, Any]:
        """Upload a trial, wait for the end of its job, and say what became of it."""
        began = time.monotonic()
        async with Api(self.server.url, key=self.server.key, wait_s=60.0) as api:
            await api.add_user(user)
            body = make_body(label or "trial", clips, finetune=True)
            token = f"{user}-{time.monotonic_ns()}"
            answer = await api.add_trial(
                user, body.content, media_type=body.media_type, token=token
            )
            job = answer["job"]
            while job is not None and job["state"] not in FINAL:
                await asyncio.sleep(0.2)
                job = await api.get_job(job["id"])
        seconds = time.monotonic() - began
        unused = sorted({clip["reason"] for clip in answer["trial"]["details"] if clip["reason"]})
        told = {"seconds": round(seconds, 1), "clips_unused": unused}
        if job is not None:
            told |= {name: job[name] for name in ("state", "reason", "message", "version")}
        return told | {"active": (await self.ask(f"/v1/users/{user}"))["version"]["number"]}

    async def ask(self, path: str) -> dict[str, Any]:
        """Ask the service with the admin key."""
        response = await self._get(path)
        found: dict[str, Any] = response.json()
        return found

    async def load(self, user: str, number: int) -> Forecaster:
        """Fetch a version's weights from the service, to be run here; 0 is the base."""
        if number == 0:
            return self.base.predictor
        response = await self._get(f"/v1/users/{user}/versions/{number}/weights")
        sha256 = self.base.sha256
        return load_personal(response.content, self.base.predictor, base_sha256=sha256)

    async def _get(self, path: str) -> httpx.Response:
        headers = {"Authorization": f"Bearer {self.server.key}"}
        async with httpx.AsyncClient(headers=headers, timeout=30.0, trust_env=False) as client:
            response = await client.get(f"{self.server.url}{path}")
            response.raise_for_status()
            return response


async def accept(bench: Bench) -> list[dict[str, Any]]:
    """Point by point: seconds to the version, the stream beside it, errors on trials 2 to 4."""
    rows = []
    for subject in SUBJECTS:
        user = f"accept-{subject}"
        beside = _start_stream(bench.server)
        await asyncio.sleep(3.0)
        told = await bench.train(user, bench.select(subject, "1"))
        stream = await asyncio.to_thread(_end_stream, beside)
        windows = cut_windows(bench.select(subject, "2", "3", "4"), SPEC)
        served, versions = await _ask_all(bench, user, windows)
        here = score_forecaster(await bench.load(user, told["active"]), windows)
        rows.append(
            {
                "subject": subject,
                **told,
                "stream": stream,
                "answered_by": versions,
                "base_cm2": _round(score_forecaster(bench.base.predictor, windows)),
                "served_cm2": _round(served),
                "here_cm2": _round(here),
                "largest_difference": _differ(served, here),
            }
        )
        _say(rows[-1])
    return rows


async def half(bench: Bench) -> list[dict[str, Any]]:
    """Train on every second action; test on these and on the others."""
    rows = []
    for subject in ("4", "2", "6"):
        trial = bench.select(subject, "1")
        own = {clip.action for clip in trial if int(clip.action) % 2 == 0}
        user = f"half-{subject}"
        told = await bench.train(user, [clip for clip in trial if clip.action in own])
        personal = await bench.load(user, told["active"])
        test = bench.select(subject, "2", "3", "4")
        row = {"subject": subject, "actions": len(own), **told}
        for name, chosen in (
            ("seen", [clip for clip in test if clip.action in own]),
            ("unseen", [clip for clip in test if clip.action not in own]),
        ):
            windows = cut_windows(chosen, SPEC)
            before, after = (
                score_forecaster(net, windows) for net in (bench.base.predictor, personal)
            )
            row[name] = {
                "base_cm2": _round(before),
                "cm2": _round(after),
                "ratio_at_15": round(after.mse_cm2[-1] / before.mse_cm2[-1], 4),
            }
        rows.append(row)
        _say(row)
    return rows


async def growth(bench: Bench) -> list[dict[str, Any]]:
    """Record one trial after the other."""
    rows = []
    for subject in SUBJECTS:
        user, windows = f"growth-{subject}", cut_windows(bench.select(subject, "4"), SPEC)
        rows.append(
            {
                "subject": subject,
                "trials": 0,
                "cm2": _base(bench, windows),
            }
        )
        _say(rows[-1])
        for trial in ("1", "2", "3"):
            told = await bench.train(user, bench.select(subject, trial), label=f"trial {trial}")
            net = await bench.load(user, told["active"])
            row = {"subject": subject, "trials": int(trial), **told}
            rows.append(row | {"cm2": _round(score_forecaster(net, windows))})
            _say(rows[-1])
    return rows


async def junk(bench: Bench) -> list[dict[str, Any]]:
    """Upload junk as a first trial and after a good one, and other people's motion."""
    good, windows = bench.select("2", "1"), cut_windows(bench.select("2", "3", "4"), SPEC)
    first = await bench.train("junk-later", good)
    rows: list[dict[str, Any]] = [{"junk": "none, to begin with", **first}]
    for name, spoil in JUNK.items():
        alone = await bench.train(f"junk-{name.replace(' ', '-')}", spoil(good))
        later = await bench.train("junk-later", spoil(bench.select("2", "2")))
        rows.append({"junk": name, "first": alone, "after_a_good_one": later})
        _say(rows[-1])
    rows.append(await _take_stranger_first(bench, windows))
    rows.append(await _take_stranger_later(bench, windows))
    return rows


async def _take_stranger_first(bench: Bench, windows: Windows) -> dict[str, Any]:
    """Record somebody else first, then the person, twice."""
    user, steps = "stranger-first", []
    for subject, trial in (("6", "1"), ("2", "1"), ("2", "2")):
        told = await bench.train(user, bench.select(subject, trial))
        net = await bench.load(user, told["active"])
        steps.append({"subject": subject, **told, "cm2": _round(score_forecaster(net, windows))})
    row = {"junk": "stranger first", "base_cm2": _base(bench, windows), "steps": steps}
    _say(row)
    return row


async def _take_stranger_later(bench: Bench, windows: Windows) -> dict[str, Any]:
    """Record somebody else after one and after two trials of the person."""
    user, steps = "stranger-later", []
    for subject, trial in (("2", "1"), ("2", "2"), ("6", "1")):
        told = await bench.train(user, bench.select(subject, trial))
        net = await bench.load(user, told["active"])
        steps.append({"subject": subject, **told, "cm2": _round(score_forecaster(net, windows))})
    row = {"junk": "stranger later", "base_cm2": _base(bench, windows), "steps": steps}
    _say(row)
    return row


PARTS: dict[str, Callable[[Bench], Any]] = {
    "accept": accept,
    "half": half,
    "growth": growth,
    "junk": junk,
}


async def _ask_all(bench: Bench, user: str, windows: Windows) -> tuple[Scores, dict[str, int]]:
    """Ask for every window by a request of its own, a few at once."""
    forecasts = np.zeros_like(windows.future)
    versions: dict[str, int] = {}
    places = iter(range(len(windows)))

    async def ask() -> None:
        async with Api(bench.server.url, key=bench.server.key) as api:
            for place in places:
                answer = await api.forecast(user, windows.observed[place])
                forecasts[place] = answer.frames
                name = f"{answer.version.kind} {answer.version.number}"
                versions[name] = versions.get(name, 0) + 1

    await asyncio.gather(*(ask() for _ in range(AT_ONCE)))
    return evaluate_forecasts(forecasts, windows.future), versions


def _start_stream(server: OwnServer) -> "subprocess.Popen[str]":
    """Run one stream at 30 Hz beside everything else."""
    command = [
        sys.executable,
        "-m",
        "app.cli",
        "bench",
        "stream",
        "--users",
        "1",
        "--repeats",
        "1",
        "--json",
    ]
    command += ["--seconds", str(STREAM_S), "--url", server.url]
    environment = make_environment() | {"KINECAST_KEY": server.key}
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)


def _end_stream(process: "subprocess.Popen[str]") -> dict[str, Any]:
    report = json.loads(process.communicate(timeout=4 * STREAM_S)[0])
    found: dict[str, Any] = report["runs"][0]
    return {name: found[name] for name in ("latency_ms", "within_33_ms", "misses")}


def _base(bench: Bench, windows: Windows) -> list[float]:
    return _round(score_forecaster(bench.base.predictor, windows))


def _round(scores: Scores) -> list[float]:
    return [round(value, 2) for value in scores.mse_cm2]


def _differ(one: Scores, other: Scores) -> float:
    ratios = np.array(one.mse_cm2) / np.array(other.mse_cm2)
    return float(np.abs(ratios - 1).max())


def _say(row: dict[str, Any]) -> None:
    print(json.dumps(row), flush=True)


def main() -> None:
    default = Path(os.environ.get("UTD_MHAD", "../shared/data/utd-mhad"))
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=default, help="UTD-MHAD, folder or zip")
    parser.add_argument("--only", default=",".join(PARTS), help="parts, such as accept,half")
    parser.add_argument("--json", type=Path, help="write the figures here")
    arguments = parser.parse_args()
    clips = load_clips(arguments.data)
    report: dict[str, Any] = {"frames": list(FRAMES)}
    with tempfile.TemporaryDirectory() as folder, run_own_server(Path(folder)) as server:
        bench = Bench(server, clips, load_checkpoint(SHIPPED))
        for part in arguments.only.split(","):
            report[part] = asyncio.run(PARTS[part](bench))
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
