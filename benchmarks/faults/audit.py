"""What must hold after every fault, read from the database and asked of the service."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any
from uuid import UUID

import numpy as np
import torch
from sqlalchemy import select
from sqlalchemy.ext.asyncio import AsyncSession

from app.commands.client.messages import Version
from app.domain.jobs import Job
from app.domain.recordings import unpack_frames
from app.domain.users import User
from app.domain.versions import Version as StoredVersion
from app.domain.versions import VersionState
from app.storage import jobs, trials, users, versions
from app.storage.database import Database
from app.storage.tables import WeightsRow
from benchmarks.faults.people import Accepted, make_window
from benchmarks.faults.watch import Log, Sighting
from models.baselines import Forecaster
from models.checkpoint import Checkpoint, load_personal
from models.skeleton import HIP_CENTER

TOLERANCE_M = 1e-4
"""Batches of other sizes sum in another order."""


@dataclass(eq=False)
class Findings:
    """What is wrong; nothing, if all is well.

    Attributes:
        lost: accepted trials that are not there, not whole, there twice or never trained on.
        doubled: jobs with more than one version or without an end, users with several active ones.
        damaged: weights that are not what their digest says.
        unanswered: forecasts that ought to have been answered.
        wrong: forecasts by weights that are not those that they name.
    """

    lost: list[str] = field(default_factory=list)
    doubled: list[str] = field(default_factory=list)
    damaged: list[str] = field(default_factory=list)
    unanswered: list[str] = field(default_factory=list)
    wrong: list[str] = field(default_factory=list)

    def as_json(self) -> dict[str, Any]:
        """Give everything, for the report."""
        return {name: list(getattr(self, name)) for name in self.__dataclass_fields__}

    @property
    def is_clean(self) -> bool:
        """Tell whether there is nothing."""
        return not any(self.as_json().values())


async def inspect(
    database: Database,
    user_id: str,
    accepted: Sequence[Accepted],
    log: Log,
    base: Checkpoint,
    *,
    seed: int,
) -> Findings:
    """Compare what a user was promised and told with what is stored."""
    findings = Findings(unanswered=list(log.unanswered))
    async with database.read() as tx:
        user = await users.get(tx, user_id)
        made = await versions.list_all(tx, user.uuid)
        every_job = await jobs.list_of_user(tx, user.uuid)
        await _check_trials(tx, user, accepted, every_job, findings)
        blobs = dict((await tx.execute(select(WeightsRow.sha256, WeightsRow.blob))).tuples().all())
    _check_jobs(every_job, made, findings)
    _check_weights(made, blobs, findings)
    _Served(base, made, blobs, seed=seed).check(log, findings)
    return findings


async def _check_trials(
    tx: AsyncSession,
    user: User,
    accepted: Sequence[Accepted],
    every_job: Sequence[Job],
    findings: Findings,
) -> None:
    stored = {trial.id for trial in await trials.list_all(tx, user)}
    if stored != {UUID(one.trial) for one in accepted}:
        findings.lost.append(f"{len(accepted)} trials were accepted, {len(stored)} are stored")
    for one in accepted:
        clips = await trials.read_clips(tx, UUID(one.trial))
        found = [unpack_frames(clip.chunks).joints for clip in clips]
        same = len(found) == len(one.upload.clips) and all(
            np.array_equal(ours, theirs)
            for ours, theirs in zip(one.upload.clips, found, strict=False)
        )
        if not same:
            findings.lost.append(f"trial {one.trial} is not what was sent")
        if not any(UUID(one.trial) in (job.trials or ()) for job in every_job):
            findings.lost.append(f"trial {one.trial} was never trained on")


def _check_jobs(
    every_job: Sequence[Job], made: Sequence[StoredVersion], findings: Findings
) -> None:
    for job in every_job:
        own = [version.number for version in made if version.job_id == job.id]
        if not job.state.is_final or len(own) > 1 or own != [job.version] * len(own):
            findings.doubled.append(f"job {job.id} is {job.state}, with versions {own}")
        if job.state not in {"succeeded", "rejected"}:
            findings.lost.append(f"job {job.id} is {job.state}: {job.message}")
    if sum(version.state is VersionState.ACTIVE for version in made) > 1:
        findings.doubled.append("several versions are active")
    if [version.number for version in made] != list(range(1, len(made) + 1)):
        findings.doubled.append("the numbers of the versions have holes")


def _check_weights(
    made: Sequence[StoredVersion], blobs: dict[str, bytes], findings: Findings
) -> None:
    for sha256, blob in blobs.items():
        if hashlib.sha256(blob).hexdigest() != sha256:
            findings.damaged.append(f"weights {sha256} are damaged")
    for version in made:
        if version.sha256 not in blobs and not version.purged:
            findings.damaged.append(f"version {version.number} has no weights")


class _Served:
    """Recomputes forecasts with the weights that they name."""

    def __init__(
        self,
        base: Checkpoint,
        made: Sequence[StoredVersion],
        blobs: dict[str, bytes],
        *,
        seed: int,
    ) -> None:
        self._window = make_window(seed)
        self._base, self._blobs = base, blobs
        self._digests: dict[int | None, str] = {v.number: v.sha256 for v in made}
        self._digests[0] = base.sha256
        self._expected: dict[str, np.ndarray] = {}

    def check(self, log: Log, findings: Findings) -> None:
        """Look at every forecast that anybody got."""
        for sighting in (*log.asked, *log.streamed):
            problem = self._find_problem(sighting)
            if problem is not None:
                findings.wrong.append(f"{problem}: {sighting.version}")

    def _find_problem(self, sighting: Sighting) -> str | None:
        version = sighting.version
        if not sighting.finite:
            return "not finite"
        if version.fallback is not None and not sighting.flagged:
            return "a fallback without a flag"
        if version.sha256 is None or self._digests.get(version.number) != version.sha256:
            return "no such version"
        if sighting.frames is None:
            return None
        off = float(np.abs(sighting.frames - self._compute(version)).max())
        return f"{off:.2g} m from what these weights give" if off > TOLERANCE_M else None

    def _compute(self, version: Version) -> np.ndarray:
        sha256 = str(version.sha256)
        if sha256 not in self._expected:
            forecaster: Forecaster = self._base.predictor
            if version.number:
                blob = self._blobs[sha256]
                forecaster = load_personal(
                    blob, self._base.predictor, base_sha256=self._base.sha256
                )
            self._expected[sha256] = _forecast(forecaster, self._window)
        return self._expected[sha256]


def _forecast(forecaster: Forecaster, window: np.ndarray) -> np.ndarray:
    """Compute without the service what weights give for a window: metres."""
    origin = window[-1:, HIP_CENTER : HIP_CENTER + 1]
    with torch.inference_mode():
        moved = forecaster(torch.from_numpy((window - origin).astype(np.float32))[None])
    return np.asarray(moved[0].numpy() + origin)
