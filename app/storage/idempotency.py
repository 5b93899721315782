"""Answers to requests that may come again: the same key, route, user and body get the same one."""

from dataclasses import dataclass
from datetime import datetime, timedelta
from uuid import UUID

from sqlalchemy import delete
from sqlalchemy.ext.asyncio import AsyncSession

from app.domain.errors import KeyReusedError
from app.storage.tables import IdempotencyRow

KEPT = timedelta(hours=24)


@dataclass(frozen=True, slots=True)
class Request:
    """What makes a request the same as an earlier one.

    Attributes:
        key_id: the API key that it came with.
        user_uuid: whom it is about.
        route: which one.
        token: the `Idempotency-Key`.
        body_sha256: of the body; another one under the same token is a mistake of the client.
    """

    key_id: UUID
    user_uuid: UUID
    route: str
    token: str
    body_sha256: str


@dataclass(frozen=True, slots=True)
class Answer:
    """What was answered: status and JSON."""

    status: int
    content: bytes


async def find(tx: AsyncSession, request: Request, *, now: datetime) -> Answer | None:
    """Look the answer of an earlier request up.

    Raises:
        KeyReusedError: the earlier one had another body.
    """
    row = await tx.get(
        IdempotencyRow, (request.key_id, request.user_uuid, request.route, request.token)
    )
    if row is None:
        return None
    if row.expires_at <= now:
        await tx.delete(row)
        await tx.flush()
        return None
    if row.body_sha256 != request.body_sha256:
        raise KeyReusedError(f"The Idempotency-Key {request.token} had another body.")
    return Answer(row.status, row.answer)


async def remember(tx: AsyncSession, request: Request, answer: Answer, *, now: datetime) -> None:
    """Keep an answer, in the transaction of what it tells; forget those that are too old."""
    await tx.execute(delete(IdempotencyRow).where(IdempotencyRow.expires_at <= now))
    tx.add(
        IdempotencyRow(
            key_id=request.key_id,
            user_uuid=request.user_uuid,
            route=request.route,
            token=request.token,
            body_sha256=request.body_sha256,
            status=answer.status,
            answer=answer.content,
            expires_at=now + KEPT,
        )
    )
