"""Recordings, claims and results for tests of the personal flow, without any training."""

from datetime import UTC, datetime, timedelta
from uuid import uuid4

import numpy as np

from app.domain.jobs import JobReason
from app.domain.recordings import RawFrames, pack_frames
from app.domain.trials import ClipInfo
from app.domain.versions import Verdict
from app.storage import jobs, keys, leases, results, trials, users
from app.storage.results import Result
from app.storage.trials import NewClip
from models.data.synthetic import SyntheticPerson

START = datetime(2026, 1, 1, tzinfo=UTC)
LEASE = timedelta(seconds=30)
BASE_SHA256 = "0" * 64


def record_frames(seconds=2.0, *, seed=1, action="wave"):
    """Frames of a believable person, as a sensor sends them."""
    joints = SyntheticPerson(seed).record(action, seconds)
    return RawFrames(t=np.arange(len(joints)) / 30.0, joints=joints)


def make_clip(ordinal=0, *, frames=None, flaw=None, action="wave"):
    frames = record_frames() if frames is None else frames
    info = ClipInfo(
        ordinal=ordinal, action=action, frames=len(frames), seconds=frames.seconds, flaw=flaw
    )
    return NewClip(info, pack_frames(frames))


async def add_user(tx, user_id="ada"):
    return await users.create(
        tx,
        user_id=user_id,
        skeleton="kinect_v1",
        up="y",
        root_relative=False,
        display_name=None,
        actor=None,
    )


async def add_trial(tx, user, *, clips=1):
    return await trials.add(
        tx, user, label=None, finetune=True, clips=[make_clip(i) for i in range(clips)]
    )


async def add_key(tx, *scopes, user_uuid=None):
    return await keys.create(
        tx, scopes=frozenset(scopes), name=None, user_uuid=user_uuid, actor=None
    )


async def enqueue(tx, user):
    return await jobs.enqueue(tx, user.uuid, reason=JobReason.TRIAL, requested_by=None)


async def claim(database, *, now=START, owner="worker", base_sha256=None):
    async with database.write() as tx:
        return await leases.claim(tx, owner=owner, lease=LEASE, now=now, base_sha256=base_sha256)


RANDOM = b""


def make_result(*, verdict=Verdict.PROMOTE, blob=RANDOM, parent=0, base_sha256=BASE_SHA256):
    return Result(
        verdict=verdict,
        message="as told",
        blob=uuid4().bytes if blob is RANDOM else blob,
        parent=parent,
        base_sha256=base_sha256,
        metrics={"before": [1.0], "after": [0.5]},
    )


async def finish(database, held, *, now=START, keep=10, **result):
    async with database.write() as tx:
        return await results.finish(tx, held, make_result(**result), now=now, keep=keep)
