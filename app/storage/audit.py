"""The log of who did what."""

from uuid import UUID

from sqlalchemy import select
from sqlalchemy.ext.asyncio import AsyncSession

from app.domain.events import Action, Event
from app.storage.tables import AuditRow


def record(
    tx: AsyncSession,
    action: Action,
    *,
    actor: UUID | None,
    user_uuid: UUID | None = None,
    key_id: UUID | None = None,
    subject: str | None = None,
) -> None:
    """Write one line, in the transaction of what it speaks of.

    Args:
        tx: that transaction.
        action: what is done.
        actor: the key that does it, None for the command line.
        user_uuid: whom it is done to; the line is erased with them.
        key_id: the key that it is done to.
        subject: the pseudonym of an erased user.
    """
    row = AuditRow(action=action, actor=actor, user_uuid=user_uuid, key_id=key_id, subject=subject)
    tx.add(row)


async def list_of_user(tx: AsyncSession, user_uuid: UUID) -> list[Event]:
    """Give every line about a user, oldest first."""
    query = select(AuditRow).where(AuditRow.user_uuid == user_uuid).order_by(AuditRow.id)
    return [
        Event(at=row.at, action=Action(row.action), actor=row.actor, key_id=row.key_id)
        for row in await tx.scalars(query)
    ]
