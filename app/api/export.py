"""`GET /v1/users/{user}/export`: everything that is stored about a person, as one zip."""

import io
import json
import tempfile
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import IO

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
from app.domain.trials import Trial
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
    try:
        await _write(database, found, file)
    except BaseException:
        file.close()
        raise
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
        """Add the lists themselves, and what makes it a zip."""
        missing = [asdict(one) for one in self._missing]
        self.add_json("manifest.json", {"files": self._zip.namelist(), "missing": missing})
        self._zip.close()


async def _write(database: Database, user: User, file: IO[bytes]) -> None:
    """Write the archive, one trial in memory at a time, beside the event loop.

    The tables are of one moment, as far as the database gives one (SQLite does; PostgreSQL gives
    each of them as it is when it is read). Trials and weights are read after them, each for
    itself, so that no transaction lasts as long as an archive takes. What is erased meanwhile is
    listed as missing; what is recorded meanwhile may be there, or not.
    """
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as zipped:
        archive = _Archive(zipped)
        stored, made, tables = await _read_tables(database, user)
        await run_in_threadpool(_add_tables, tables, archive)
        for trial in stored:
            async with database.read() as tx:
                clips = await trials.read_clips(tx, trial.id)
            await run_in_threadpool(_add_clips, trial, clips, archive)
        for version in made:
            await _add_weights(database, version, archive)
        await run_in_threadpool(archive.close)


async def _read_tables(
    database: Database, user: User
) -> tuple[list[Trial], list[Version], dict[str, object]]:
    """Read everything but frames and weights; gives the trials and versions to read them of."""
    async with database.read() as tx:
        stored = await trials.list_all(tx, user)
        made = await versions.list_all(tx, user.uuid)
        lived = await users.read_lived(tx, user.uuid)
        tables: dict[str, object] = {
            "user": show_plainly(user),
            "body": {"seen_live": None if lived is None else asdict(lived)},
            "events": [asdict(event) for event in await audit.list_of_user(tx, user.uuid)],
            "trials": [asdict(trial) for trial in stored],
            "jobs": [asdict(job) for job in await jobs.list_of_user(tx, user.uuid)],
            "versions": [asdict(version) for version in made],
            "activations": [asdict(one) for one in await versions.list_history(tx, user.uuid)],
        }
    return stored, made, tables


def _add_tables(tables: Mapping[str, object], archive: _Archive) -> None:
    for name, content in tables.items():
        archive.add_json(f"{name}.json", content)


def _add_clips(trial: Trial, clips: Sequence[StoredClip], archive: _Archive) -> None:
    """Add the clips of a trial; those that were listed and are gone were erased since."""
    found = {clip.info.ordinal: clip for clip in clips}
    for ordinal in sorted(found.keys() | {clip.ordinal for clip in trial.clips}):
        path = f"trials/{trial.id}/clip-{ordinal:03}.npz"
        if ordinal not in found:
            archive.miss(path, "erased")
            continue
        try:
            archive.add(path, _write_clip(found[ordinal]))
        except DamagedChunkError as error:
            log.warning("a stored clip is damaged", file=path, why=str(error))
            archive.miss(path, "damaged")


async def _add_weights(database: Database, version: Version, archive: _Archive) -> None:
    path = f"versions/{version.number}.safetensors"
    try:
        async with database.read() as tx:
            blob = await weights.get(tx, _name_weights(version))
    except (WeightsPurgedError, WeightsDamagedError) as error:
        archive.miss(path, error.code)
        return
    await run_in_threadpool(archive.add, path, blob)


def _name_weights(version: Version) -> str:
    """Tell what the weights of a version are called.

    Raises:
        WeightsPurgedError: it has none any more.
    """
    if version.purged:
        raise WeightsPurgedError
    return version.sha256


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
