"""One real person from the first recorded frame to a forecast of their own, on one stream.

Run it with `make live` (needs the UTD-MHAD recordings; about four minutes). It starts a service of
its own with default settings, opens one stream, records trial 1 on it clip by clip in real time,
goes on with trial 2 until the `version` message arrives on that very stream, and then for a while.
Every frame must be answered or accounted for once, every forecast must be what the version that it
names gives when computed here, and the stored trial must be what was sent.
"""

import argparse
import asyncio
import gc
import json
import os
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import Any

import httpx

from app.commands.client.errors import ClientError
from app.commands.client.messages import MSGPACK, Job
from app.commands.client.rest import Api
from app.commands.own_server import OwnServer, run_own_server
from app.settings import load_settings
from benchmarks.live.check import (
    TOLERANCE_M,
    Net,
    compare,
    compare_stored,
    compute_offline,
    count_frames,
    count_strays,
)
from benchmarks.live.story import (
    NothingToTellError,
    find_end,
    find_swap,
    list_stages,
    measure_errors,
    measure_latency,
    tell_latency,
)
from benchmarks.live.take import RATE_HZ, Script, play
from benchmarks.live.timeline import Timeline, draw
from models.checkpoint import SHIPPED, Checkpoint, load_checkpoint, load_personal
from models.data.clips import load_clips
from models.personal import PersonalDecoder

FIGURE = Path("docs/figures/personalisation.svg")
USER = "live"
WAIT_S = 60.0


def main() -> int:
    arguments = _read_arguments()
    script = _write_script(arguments)
    if not script.record or not script.show:
        print(f"no clips of subject {arguments.subject}, trials 1 and 2")
        return 2
    base = load_checkpoint(load_settings().model or SHIPPED)
    try:
        with tempfile.TemporaryDirectory() as folder, run_own_server(Path(folder)) as server:
            report, timeline = asyncio.run(_run(script, server, base, subject=arguments.subject))
    except (ClientError, NothingToTellError) as error:
        print(f"no result: {error}", file=sys.stderr)
        return 1
    print(json.dumps(report, indent=1))
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(report, indent=1) + "\n")
    if arguments.figure is not None:
        arguments.figure.parent.mkdir(parents=True, exist_ok=True)
        arguments.figure.write_text(draw(timeline))
    wrong = [name for name, holds in report["holds"].items() if not holds]
    for name in wrong:
        print(f"does not hold: {name}", file=sys.stderr)
    return 1 if wrong else 0


def _read_arguments() -> argparse.Namespace:
    default = Path(os.environ.get("UTD_MHAD", "../shared/data/utd-mhad"))
    parser = argparse.ArgumentParser(prog="python -m benchmarks.live", description=__doc__)
    parser.add_argument("--data", type=Path, default=default, help="UTD-MHAD, folder or zip")
    parser.add_argument("--subject", default="2")
    parser.add_argument("--speed", type=float, default=1.0, help="1 is real time; 4 at most")
    parser.add_argument("--after", type=float, default=30.0, help="seconds to go on afterwards")
    parser.add_argument("--patience", type=float, default=900.0, help="longest wait, in seconds")
    parser.add_argument("--json", type=Path, help="write the figures here")
    parser.add_argument("--figure", type=Path, help=f"draw the timeline here, such as {FIGURE}")
    return parser.parse_args()


def _write_script(arguments: argparse.Namespace) -> Script:
    record, show = (
        load_clips(arguments.data, subjects=[arguments.subject], trials=[trial]) for trial in "12"
    )
    return Script(
        record,
        show,
        speed=arguments.speed,
        after_s=arguments.after,
        patience_s=arguments.patience,
    )


async def _run(
    script: Script, server: OwnServer, base: Checkpoint, *, subject: str
) -> tuple[dict[str, Any], Timeline]:
    """Play the script, then check and tell what came of it."""
    load = round(os.getloadavg()[0], 1)
    async with Api(server.url, key=server.key, wait_s=WAIT_S) as api:
        await api.add_user(USER)
        gc.collect()
        gc.disable()  # its pauses would be in the latency
        take = await play(script, url=server.url, key=server.key, user=USER, subprotocol=MSGPACK)
        gc.enable()
        told = [message for _, message in take.heard if isinstance(message, Job)]
        if not told:
            raise NothingToTellError("the stream was told of no job")
        job = await api.get_job(told[-1].id)
    swap = find_swap(take, job)
    async with _open(server) as client:
        personal = await _fetch_versions(client, base)
        archive = (await client.get(f"/v1/users/{USER}/export")).raise_for_status().content
    nets: dict[str, Net] = {base.sha256: base.predictor, **personal}
    offline = compute_offline(take, nets)
    fit_steps = next(iter(personal.values())).metadata["finetuning"]["steps"]
    stages = list_stages(take, job, fit_steps=fit_steps)
    errors = measure_errors(take, offline, base_sha256=base.sha256, speed=script.speed)
    facts = {
        "frames": count_frames(take),
        "forecasts": compare(offline) | {"by_another_version": count_strays(take, base.sha256)},
        "stored": compare_stored(take, archive),
    }
    report = {
        "subject": subject,
        "speed": script.speed,
        "machine": {"cores": os.cpu_count(), "load_before": load},
        "seconds": round(find_end(take), 1),
        "recorded_s": round(sum(len(clip.poses) for clip in script.record) / RATE_HZ, 1),
        "job": {name: job[name] for name in ("state", "reason", "message", "version", "attempt")},
        "stages_s": {stage.kind: round(stage.seconds, 2) for stage in stages},
        "swap_s": {name: round(at, 3) for name, at in asdict(swap).items()},
        "error_500_ms": {
            "before": errors.mean(errors.came < swap.told),
            "after": errors.mean(errors.came >= swap.first),
        },
        "latency": tell_latency(take, stages, swap),
        **facts,
        "holds": _judge(**facts),
    }
    timeline = Timeline(report, stages, swap, errors, *measure_latency(take))
    return report, timeline


def _open(server: OwnServer) -> httpx.AsyncClient:
    headers = {"Authorization": f"Bearer {server.key}"}
    return httpx.AsyncClient(base_url=server.url, headers=headers, timeout=WAIT_S, trust_env=False)


async def _fetch_versions(
    client: httpx.AsyncClient, base: Checkpoint
) -> dict[str, PersonalDecoder]:
    """Fetch the weights of every version, by their sha256."""
    found = {}
    listed = (await client.get(f"/v1/users/{USER}/versions")).raise_for_status().json()
    for version in listed["items"]:
        if version["number"] == 0:
            continue
        path = f"/v1/users/{USER}/versions/{version['number']}/weights"
        blob = (await client.get(path)).raise_for_status().content
        found[version["sha256"]] = load_personal(blob, base.predictor, base_sha256=base.sha256)
    return found


def _judge(
    frames: dict[str, Any], forecasts: dict[str, Any], stored: dict[str, Any]
) -> dict[str, bool]:
    """Tell what the take has to show."""
    return {
        "no frame is missing": frames["missing"] == 0,
        "no frame is answered twice": frames["twice"] == 0,
        "forecasts are those of the version that they name": all(
            off <= TOLERANCE_M for off in forecasts["largest_difference_m"].values()
        ),
        "forecasts differ from those of other versions": forecasts["as_near_to_others"] == 0,
        "no forecast is by weights that were not announced": forecasts["by_another_version"] == 0,
        "the stored trial is what was sent": stored["equal"],
    }


if __name__ == "__main__":
    sys.exit(main())
