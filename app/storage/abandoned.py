"""Recordings whose stream is gone and does not come back."""

from datetime import datetime
from uuid import UUID

from sqlalchemy import ColumnElement, exists, literal_column, select, update
from sqlalchemy.ext.asyncio import AsyncSession

from app.domain.trials import TrialState
from app.storage.tables import TrialRow


async def has_abandoned(tx: AsyncSession, *, before: datetime) -> bool:
    """Tell whether there is any recording whose stream is silent since then."""
    return bool(await tx.scalar(select(exists().where(*_abandoned(before)))))


async def store_abandoned(tx: AsyncSession, *, before: datetime, now: datetime) -> list[UUID]:
    """Complete recordings whose stream is silent since then, without a job; gives their ids."""
    rows = await tx.scalars(
        update(TrialRow)
        .where(*_abandoned(before))
        .values(state=TrialState.STORED, finetune=False, stored_at=now)
        .returning(TrialRow.id)
        .execution_options(synchronize_session=False)
    )
    return list(rows)


def _abandoned(before: datetime) -> tuple[ColumnElement[bool], ...]:
    """Name recordings that are silent since then: in the words of the index that has them all."""
    is_recording = TrialRow.state == literal_column(f"'{TrialState.RECORDING}'")
    return is_recording, TrialRow.touched_at < before
