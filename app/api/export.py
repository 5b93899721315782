"""`GET /v1/users/{user}/export`: everything that is stored about a person, as one zip."""

import io
import json
import tempfile
import zipfile
from collections.abc import Iterator
from dataclasses import asdict
from typing import IO, Any

import numpy as np
from fastapi import APIRouter
from fastapi.responses import StreamingResponse
from starlette.concurrency import run_in_threadpool

from app.api.dependencies import Admin, DatabaseNeeded, UserId
from app.api.openapi import DENIED, needs, problems
from app.domain import errors
from app.domain.access import Scope
from app.domain.events import Action
from app.domain.recordings import unpack_frames
from app.domain.users import User
from app.storage import audit, jobs, trials, users, versions, weights
from app.storage.database import Database
from app.storage.trials import StoredClip

router = APIRouter(tags=["users"])
IN_MEMORY = 8 * 2**20
CHUNK = 2**18
ZIP_TYPE = "application/zip"


@router.get(
    "/v1/users/{user}/export",
    summary="Export a user",
    openapi_extra=needs(Scope.ADMIN),
    response_class=StreamingResponse,
    responses={
        200: {
            "content": {ZIP_TYPE: {"schema": {"type": "string", "format": "binary"}}},
            "description": "A zip archive: JSON, a .npz of each clip, weights as safetensors.",
        },
        **problems(*DENIED, errors.UnknownUserError),
    },
)
async def export_user(caller: Admin, user: UserId, database: DatabaseNeeded) -> StreamingResponse:
    """Give everything that is stored about a user: trials with their frames, versions, events."""
    async with database.write() as tx:
        found = await users.get(tx, user)
        audit.record(tx, Action.USER_EXPORTED, actor=caller.key_id, user_uuid=found.uuid)
    file = tempfile.SpooledTemporaryFile(max_size=IN_MEMORY)  # noqa: SIM115 - closed by `_read`
    await _write(database, found, file)
    headers = {"Content-Disposition": f'attachment; filename="{found.id}.zip"'}
    return StreamingResponse(_read(file), media_type=ZIP_TYPE, headers=headers)


def show_plainly(user: User) -> dict[str, object]:
    """Show what is stored of a user, without what only the database knows."""
    return {name: value for name, value in asdict(user).items() if name != "uuid"}


async def _write(database: Database, user: User, file: IO[bytes]) -> None:
    """Write the archive from one view of the database, one trial in memory at a time."""
    async with database.read() as tx:
        tables: dict[str, Any] = {
            "user": show_plainly(user),
            "events": [asdict(event) for event in await audit.list_of_user(tx, user.uuid)],
            "trials": [asdict(trial) for trial in await trials.list_all(tx, user)],
            "jobs": [asdict(job) for job in await jobs.list_of_user(tx, user.uuid)],
            "versions": [asdict(v) for v in await versions.list_all(tx, user.uuid)],
            "activations": [asdict(line) for line in await versions.list_history(tx, user.uuid)],
        }
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, content in tables.items():
                archive.writestr(f"{name}.json", json.dumps(content, default=str, indent=2))
            for trial in tables["trials"]:
                for clip in await trials.read_clips(tx, trial["id"]):
                    path = f"trials/{clip.trial_id}/clip-{clip.info.ordinal:03}.npz"
                    archive.writestr(path, await run_in_threadpool(_write_clip, clip))
            for version in tables["versions"]:
                if not version["purged"]:
                    blob = await weights.get(tx, version["sha256"])
                    archive.writestr(f"versions/{version['number']}.safetensors", blob)


def _write_clip(clip: StoredClip) -> bytes:
    """Write the frames of a clip as they were received."""
    frames = unpack_frames(clip.chunks)
    arrays = {"t": frames.t, "joints": frames.joints}
    if frames.confidence is not None:
        arrays["confidence"] = frames.confidence
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # type: ignore[arg-type] # numpy's stub takes a name for a flag
    return buffer.getvalue()


def _read(file: IO[bytes]) -> Iterator[bytes]:
    with file:
        file.seek(0)
        while chunk := file.read(CHUNK):
            yield chunk
