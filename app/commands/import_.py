"""`kinecast import`: recordings in files, uploaded as trials of a user."""

import asyncio
import hashlib
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import httpx
import msgspec
import typer
from rich.progress import track

from app.commands.client.errors import ApiError, ClientError
from app.commands.client.rest import Api
from app.commands.output import err, fail, out
from app.commands.target import Target, find_target
from models.data.clips import Clip, load_clips
from models.data.utd_mhad import RecordingError

WAIT_S = 120.0
POLL_S = 0.5
FINAL = frozenset({"succeeded", "rejected", "failed", "cancelled"})


@dataclass(frozen=True, slots=True)
class Batch:
    """One trial to upload: what to call it, and the request."""

    label: str
    content: bytes
    media_type: str


def import_command(
    user: Annotated[str, typer.Option(help="Id of the user; made where there is none.")],
    data: Annotated[
        Path, typer.Option(help="Folder or zip of UTD-MHAD, a .mat, .npz or .csv file.")
    ],
    subject: Annotated[
        str | None, typer.Option(help="The person in the recordings; needed where there are more.")
    ] = None,
    trials: Annotated[
        str | None, typer.Option(help="Which trials, such as 1 or 1,2; by default all.")
    ] = None,
    url: Annotated[
        str | None, typer.Option(help="The service.", show_default="http://127.0.0.1:8000")
    ] = None,
    key: Annotated[
        str | None, typer.Option(help="API key; by default KINECAST_KEY.", show_default=False)
    ] = None,
    data_dir: Annotated[
        Path | None,
        typer.Option(help="Folder of a service on this machine: its key.", show_default="var"),
    ] = None,
    *,
    finetune: Annotated[
        bool, typer.Option("--finetune/--no-finetune", help="Ask for fine-tuning on them.")
    ] = True,
    wait: Annotated[
        bool, typer.Option("--wait", help="Wait for the job to end; needs an admin key.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print what was answered.")] = False,
) -> None:
    """Upload recordings as trials of a user; the same ones again change nothing for a day."""
    batches = _read(data, subject=subject, trials=trials, finetune=finetune)
    target = find_target(url=url, key=key, data_dir=data_dir)
    try:
        answers = asyncio.run(_upload(target, user, batches, wait=wait))
    except ClientError as error:
        fail(str(error), status=1)
    if as_json:
        typer.echo(json.dumps(answers, indent=2))
        return
    for answer in answers:
        _print(answer)


def _read(data: Path, *, subject: str | None, trials: str | None, finetune: bool) -> list[Batch]:
    """Make one request of every trial."""
    if data.suffix.lower() == ".csv":
        return [_make_form(data, finetune=finetune)]
    chosen = None if trials is None else {trial.strip() for trial in trials.split(",")}
    try:
        clips = load_clips(data, subjects=None if subject is None else {subject}, trials=chosen)
    except RecordingError as error:
        fail(str(error), status=2)
    if not clips:
        fail(_explain_nothing(data, subject, trials), status=2)
    people = sorted({clip.subject for clip in clips})
    if len(people) > 1:
        fail(f"The recordings show {', '.join(people)}: choose one with --subject.", status=2)
    groups: dict[str, list[Clip]] = {}
    for clip in clips:
        groups.setdefault(clip.trial, []).append(clip)
    return [
        make_body(f"trial {trial}", group, finetune=finetune) for trial, group in groups.items()
    ]


def _explain_nothing(data: Path, subject: str | None, trials: str | None) -> str:
    """Name what was asked for and is not there."""
    told = f"no clips of subject {subject or 'any'} and trials {trials or 'any'} in {data}"
    may_have_names = data.suffix.lower() == ".npz"  # elsewhere trials are numbers
    if trials is None or may_have_names or re.fullmatch(r"\s*\d+\s*(,\s*\d+\s*)*", trials):
        return told
    return f"--trials {trials} is no list of trials, such as 1 or 1,2: {told}"


def make_body(label: str, clips: Sequence[Clip], *, finetune: bool) -> Batch:
    """Make the request that uploads clips as one trial."""
    content = {
        "label": label,
        "clips": [_write_clip(clip) for clip in clips],
        "finetune": finetune,
    }
    return Batch(label, msgspec.msgpack.encode(content), "application/msgpack")


def _write_clip(clip: Clip) -> dict[str, Any]:
    poses = clip.poses.astype("<f4")
    frames = {"shape": list(poses.shape), "dtype": "<f4", "data": poses.tobytes()}
    t = [i / clip.rate_hz for i in range(len(poses))]
    return {"frames": frames, "t": t, "action": clip.action or None}


def _make_form(path: Path, *, finetune: bool) -> Batch:
    try:
        files = {"file": (path.name, path.read_bytes(), "text/csv")}
    except OSError as error:
        fail(f"{path}: {error.strerror}.", status=2)
    fields = {"label": path.stem[:200], "finetune": "true" if finetune else "false"}
    # a boundary of the content itself, so that the same file is the same request
    boundary = hashlib.sha256(files["file"][1]).hexdigest()
    headers = {"Content-Type": f"multipart/form-data; boundary={boundary}"}
    request = httpx.Request("POST", "http://form", headers=headers, files=files, data=fields)
    return Batch(path.stem, request.read(), request.headers["content-type"])


async def _upload(
    target: Target, user: str, batches: Sequence[Batch], *, wait: bool
) -> list[dict[str, Any]]:
    async with Api(target.url, key=target.key, wait_s=WAIT_S) as api:
        await _add_user(api, user)
        answers = []
        for batch in track(batches, "uploading", console=err, disable=not err.is_terminal):
            token = hashlib.sha256(batch.content).hexdigest()
            answers.append(
                await api.add_trial(user, batch.content, media_type=batch.media_type, token=token)
            )
        if wait:
            for answer in answers:
                await _follow(api, answer)
        return answers


async def _add_user(api: Api, user: str) -> None:
    """Make the user where there is none; a key that may not has to find one."""
    try:
        await api.add_user(user)
    except ApiError as error:
        if error.status != httpx.codes.FORBIDDEN:
            raise


async def _follow(api: Api, answer: dict[str, Any]) -> None:
    """Wait for the end of the job, and put that into the answer."""
    while answer["job"] is not None and answer["job"]["state"] not in FINAL:
        await asyncio.sleep(POLL_S)
        answer["job"] = await api.get_job(answer["job"]["id"])


def _print(answer: dict[str, Any]) -> None:
    trial, job = answer["trial"], answer["job"]
    out.print(
        f"{trial['label'] or trial['id']}: {trial['clips']} clips, {trial['seconds']:.0f} s, "
        f"{trial['clips_unused']} not used",
        markup=False,
    )
    for clip in trial["details"]:
        if not clip["used"]:
            out.print(f"  clip {clip['ordinal']}: {clip['message']}", markup=False)
    if job is not None:
        told = f" ({job['message']})" if job["message"] else ""
        out.print(f"  job {job['id']}: {job['state']}{told}", markup=False)
