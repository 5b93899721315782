"""The time that processes on several machines agree on: the database's."""

from datetime import datetime

from sqlalchemy import func, select
from sqlalchemy.ext.asyncio import AsyncSession

from app.storage.tables import utc_now


async def read_clock(tx: AsyncSession) -> datetime:
    """Give the time by which leases and recordings run out, of PostgreSQL where that is shared.

    By its own clock, a machine that is a minute fast would take for dead what others work on.
    """
    if tx.get_bind().dialect.name == "sqlite":
        return utc_now()
    moment: datetime = (await tx.execute(select(func.clock_timestamp()))).scalar_one()
    return moment
