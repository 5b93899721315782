"""Versions for the people of a benchmark: everybody's own weights, without anybody's recordings."""

import asyncio
import copy
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch

from app.domain.versions import ActivationKind, VersionState
from app.settings import Settings
from app.storage import users, versions
from app.storage.database import Database
from app.storage.versions import NewVersion
from models.checkpoint import SHIPPED, Checkpoint, dump_personal, load_checkpoint
from models.decoder import Decoder
from models.rounding import round_matrices

SPREAD = 0.02
"""How far the weights of different people are apart, as a part of the base's."""


def give_versions(settings: Settings, user_ids: Sequence[str], *, each: int = 1) -> None:
    """Store versions for each user and make the last one active; all weights are different.

    They have no gate, so that every forecast is wholly personal, and so no correction either.

    Args:
        settings: of the service, for its database and its base.
        user_ids: who gets them.
        each: how many.
    """
    base = load_checkpoint(settings.model or SHIPPED)
    asyncio.run(_store(settings, [user for user in user_ids for _ in range(each)], base))


def vary(base: Decoder) -> Iterator[Decoder]:
    """Give one person's decoder after the other's, near the base's."""
    draw = torch.Generator().manual_seed(0)
    while True:
        decoder = copy.deepcopy(base)
        with torch.no_grad():
            for weight in decoder.parameters():
                weight.mul_(1 + SPREAD * torch.randn(weight.shape, generator=draw))
        yield decoder


async def _store(settings: Settings, user_ids: Sequence[str], base: Checkpoint) -> None:
    database = Database.from_settings(settings)
    try:
        for user_id, decoder in zip(user_ids, vary(base.predictor.decoder), strict=False):
            round_matrices(decoder)
            new = NewVersion(
                blob=dump_personal(decoder, {"radius_scale": 1.0}, base_sha256=base.sha256),
                parent=0,
                base_sha256=base.sha256,
                trained_on=(),
                metrics={},
                job_id=None,
                state=VersionState.CANDIDATE,
            )
            async with database.write() as tx:
                user = await users.get(tx, user_id)
                version = await versions.add(tx, user.uuid, new)
                await versions.activate(
                    tx, user.uuid, version.number, kind=ActivationKind.PROMOTED, actor=None
                )
    finally:
        await database.close()


def find_settings(folder: Path) -> Settings:
    """Give the settings of a service of one's own that keeps its data in a folder."""
    return Settings(data_dir=folder, database_url=None, redis_url=None)
