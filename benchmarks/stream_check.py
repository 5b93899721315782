"""Stream real recordings to a service in real time, and compare its errors with `evaluate`'s.

Run it with `make stream-check`. Every clip of the trial goes through the WebSocket at 30 Hz, in
both subprotocols at once, and window by window through the single request. The errors of what came
back have to equal those of the net on the same windows to 0.1 %.
"""

import argparse
import asyncio
import json
import os
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from app.commands.client.messages import SUBPROTOCOLS
from app.commands.client.rest import Api
from app.commands.own_server import OwnServer, run_own_server
from app.settings import load_settings
from benchmarks.replay import (
    Replay,
    ask_single,
    compare,
    gather,
    replay_clips,
    select_answered,
)
from models.baselines import Forecaster
from models.checkpoint import SHIPPED, load_checkpoint
from models.data.clips import Clip, load_clips
from models.data.windows import Windows

TOLERANCE = 1e-3


def main() -> int:
    arguments = _read_arguments()
    clips = load_clips(arguments.data, subjects=[arguments.subject], trials=[arguments.trial])
    if not clips:
        print(f"no clips of subject {arguments.subject}, trial {arguments.trial}")
        return 2
    checkpoint = load_checkpoint(load_settings().model or SHIPPED)
    with tempfile.TemporaryDirectory() as folder, run_own_server(Path(folder)) as server:
        rows = asyncio.run(_check(clips, server, checkpoint.predictor, speed=arguments.speed))
    print(f"{len(clips)} clips at {arguments.speed:g} times real time, model {checkpoint.sha256}")
    print("\n".join(_describe(row) for row in rows))
    if arguments.json is not None:
        report = {"model_sha256": checkpoint.sha256, "speed": arguments.speed, "rows": rows}
        arguments.json.write_text(json.dumps(report, indent=2) + "\n")
    wrong = [row["route"] for row in rows if not row["equal"]]
    for name in wrong:
        print(f"not equal: {name}", file=sys.stderr)
    return 1 if wrong else 0


def _read_arguments() -> argparse.Namespace:
    default = Path(os.environ.get("UTD_MHAD", "../shared/data/utd-mhad"))
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=default, help="UTD-MHAD, folder or zip")
    parser.add_argument("--subject", default="2")
    parser.add_argument("--trial", default="2")
    parser.add_argument("--speed", type=float, default=1.0, help="1 is real time")
    parser.add_argument("--json", type=Path, help="write the figures here")
    return parser.parse_args()


async def _check(
    clips: Sequence[Clip], server: OwnServer, forecaster: Forecaster, *, speed: float
) -> list[dict[str, Any]]:
    async with Api(server.url, key=server.key) as api:
        for form in SUBPROTOCOLS:
            await api.add_user(form)
    replays = await asyncio.gather(
        *(
            replay_clips(
                clips,
                url=server.url,
                key=server.key,
                user=form,
                subprotocol=subprotocol,
                speed=speed,
            )
            for form, subprotocol in SUBPROTOCOLS.items()
        )
    )
    rows = []
    for form, replay in zip(SUBPROTOCOLS, replays, strict=True):
        windows = select_answered(clips, replay)
        served = gather(windows, replay)
        rows.append(
            {"route": f"stream, {form}", **_count(replay, windows)}
            | _tell(compare(served, windows, forecaster), complete=replay.unanswered == 0)
        )
        single = await ask_single(windows, url=server.url, key=server.key, user=form, form=form)
        rows.append(
            {"route": f"single request, {form}", "windows": len(windows)}
            | _tell(compare(single, windows, forecaster), complete=True)
        )
    return rows


def _describe(row: dict[str, Any]) -> str:
    counts = ", ".join(
        f"{row[name]} {name}"
        for name in ("frames", "answered", "waiting", "skipped", "unanswered")
        if name in row
    )
    return (
        f"{row['route']}: {row['windows']} windows, at frame 15 {row['mse_cm2'][-1]} cm² "
        f"(evaluate {row['evaluate_mse_cm2'][-1]}), largest relative difference of any figure "
        f"{row['largest_relative_difference']}, {'equal' if row['equal'] else 'NOT EQUAL'}"
        + (f"\n  {counts}, errors {row['errors']}, flags {row['flags']}" if counts else "")
    )


def _count(replay: Replay, windows: Windows) -> dict[str, Any]:
    return {
        "windows": len(windows),
        "frames": replay.sent,
        "answered": len(replay.forecasts),
        "waiting": replay.covered,
        "skipped": replay.skipped,
        "unanswered": replay.unanswered,
        "errors": replay.errors,
        "flags": sorted(replay.flags),
    }


def _tell(comparison: tuple[Any, Any, float], *, complete: bool) -> dict[str, Any]:
    served, direct, difference = comparison
    return {
        "mse_cm2": [round(value, 4) for value in served.mse_cm2],
        "evaluate_mse_cm2": [round(value, 4) for value in direct.mse_cm2],
        "largest_relative_difference": float(f"{difference:.2e}"),
        "equal": complete and difference <= TOLERANCE,
    }


if __name__ == "__main__":
    sys.exit(main())
