"""`GET /v1/users/{user}/export`: everything that is stored about a person, as one zip."""

import io
import json
import tempfile
import zipfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import IO, Any

import numpy as np
import structlog
from fastapi import APIRouter
from fastapi.responses import StreamingResponse
from starlette.concurrency import run_in_threadpool

from app.api.dependencies import Admin, DatabaseNeeded, UserId
from app.api.openapi import DENIED, needs, problems
from app.domain import errors
from app.domain.access import Scope
from app.domain.errors import WeightsDamagedError, WeightsPurgedError
from app.domain.events import Action
from app.domain.recordings import DamagedChunkError, unpack_frames
from app.domain.users import User
from app.domain.versions import Version
from app.storage import audit, jobs, trials, users, versions, weights
from app.storage.database import Database
from app.storage.trials import StoredClip

router = APIRouter(tags=["users"])
IN_MEMORY = 8 * 2**20
CHUNK = 2**18
ZIP_TYPE = "application/zip"

log = structlog.get_logger(__name__)


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


@dataclass(frozen=True, slots=True)
class _Missing:
    """A file that should be in the archive and cannot be."""

    file: str
    reason: str


class _Archive:
    """A zip that keeps a list of what is in it, and of what should be."""

    def __init__(self, zipped: zipfile.ZipFile) -> None:
        self._zip = zipped
        self._missing: list[_Missing] = []

    def add(self, name: str, content: bytes | str) -> None:
        """Add a file."""
        self._zip.writestr(name, content)

    def add_json(self, name: str, content: object) -> None:
        """Add a table."""
        self.add(name, json.dumps(content, default=str, indent=2))

    def miss(self, name: str, reason: str) -> None:
        """Take note of a file that cannot be read."""
        self._missing.append(_Missing(name, reason))

    def close(self) -> None:
        """Add the lists themselves."""
        missing = [asdict(one) for one in self._missing]
        self.add_json("manifest.json", {"files": self._zip.namelist(), "missing": missing})


async def _write(database: Database, user: User, file: IO[bytes]) -> None:
    """Write the archive from one view of the database, one trial in memory at a time."""
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as zipped:
        archive = _Archive(zipped)
        async with database.read() as tx:
            stored = await trials.list_all(tx, user)
            made = await versions.list_all(tx, user.uuid)
            lived = await users.read_lived(tx, user.uuid)
            tables: dict[str, Any] = {
                "user": show_plainly(user),
                "body": {"seen_live": None if lived is None else asdict(lived)},
                "events": [asdict(event) for event in await audit.list_of_user(tx, user.uuid)],
                "trials": [asdict(trial) for trial in stored],
                "jobs": [asdict(job) for job in await jobs.list_of_user(tx, user.uuid)],
                "versions": [asdict(version) for version in made],
                "activations": [asdict(one) for one in await versions.list_history(tx, user.uuid)],
            }
            for name, content in tables.items():
                archive.add_json(f"{name}.json", content)
            for trial in stored:
                for clip in await trials.read_clips(tx, trial.id):
                    await _add_clip(clip, archive)
            for version in made:
                path = f"versions/{version.number}.safetensors"
                try:
                    archive.add(path, await weights.get(tx, _name_weights(version)))
                except (WeightsPurgedError, WeightsDamagedError) as error:
                    archive.miss(path, error.code)
        archive.close()


def _name_weights(version: Version) -> str:
    """Tell what the weights of a version are called.

    Raises:
        WeightsPurgedError: it has none any more.
    """
    if version.purged:
        raise WeightsPurgedError
    return version.sha256


async def _add_clip(clip: StoredClip, archive: _Archive) -> None:
    path = f"trials/{clip.trial_id}/clip-{clip.info.ordinal:03}.npz"
    try:
        archive.add(path, await run_in_threadpool(_write_clip, clip))
    except DamagedChunkError as error:
        log.warning("a stored clip is damaged", file=path, why=str(error))
        archive.miss(path, "damaged")


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
