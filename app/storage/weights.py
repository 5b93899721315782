"""Weights: immutable blobs, named by their digest. The digest is checked whenever one is read."""

import hashlib
from collections.abc import Collection
from typing import Literal

from sqlalchemy import delete, exists, select
from sqlalchemy.ext.asyncio import AsyncSession

from app.domain.errors import WeightsDamagedError, WeightsPurgedError
from app.storage.dialects import upsert
from app.storage.tables import VersionRow, WeightsRow

Kind = Literal["base", "personal"]


async def put(tx: AsyncSession, blob: bytes, *, kind: Kind) -> str:
    """Store weights, unless they are stored already; gives their sha256."""
    sha256 = hashlib.sha256(blob).hexdigest()
    row = {"sha256": sha256, "kind": kind, "size": len(blob), "blob": blob}
    # An update of nothing locks the row, so that it is not purged before it is referred to.
    await upsert(tx, WeightsRow, row, on=("sha256",), change={"sha256": sha256})
    return sha256


async def has(tx: AsyncSession, sha256: str) -> bool:
    """Tell whether weights are stored, without reading them."""
    return bool(await tx.scalar(select(exists().where(WeightsRow.sha256 == sha256))))


async def list_stored(tx: AsyncSession, sha256s: Collection[str]) -> set[str]:
    """Tell which of these weights are still stored."""
    if not sha256s:
        return set()
    query = select(WeightsRow.sha256).where(WeightsRow.sha256.in_(sha256s))
    return set(await tx.scalars(query))


async def get(tx: AsyncSession, sha256: str) -> bytes:
    """Read weights.

    Raises:
        WeightsPurgedError: they are not there any more.
        WeightsDamagedError: they are not what they were.
    """
    blob = await tx.scalar(select(WeightsRow.blob).where(WeightsRow.sha256 == sha256))
    if blob is None:
        raise WeightsPurgedError("These weights were removed.")
    if hashlib.sha256(blob).hexdigest() != sha256:
        raise WeightsDamagedError(f"The weights {sha256} are damaged.")
    return blob


async def drop_unused(tx: AsyncSession) -> None:
    """Remove personal weights that no version refers to any more."""
    used = exists().where(VersionRow.weights_sha256 == WeightsRow.sha256)
    await tx.execute(delete(WeightsRow).where(WeightsRow.kind == "personal", ~used))
