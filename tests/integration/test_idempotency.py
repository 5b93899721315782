from dataclasses import replace
from datetime import timedelta

import pytest
import pytest_asyncio
from sqlalchemy import func, select

from app.domain.access import Scope
from app.domain.errors import KeyReusedError
from app.storage import idempotency
from app.storage.idempotency import Answer, Request
from app.storage.tables import IdempotencyRow
from tests.personal_support import START, add_key, add_user

pytestmark = pytest.mark.asyncio
ANSWER = Answer(202, b"{}")


@pytest_asyncio.fixture
async def request_(database):
    async with database.write() as tx:
        user = await add_user(tx)
        key = await add_key(tx, Scope.RECORD)
    return Request(
        key_id=key.id, user_uuid=user.uuid, route="trials", token="a", body_sha256="0" * 64
    )


async def remember(database, request, now=START):
    async with database.write() as tx:
        await idempotency.remember(tx, request, ANSWER, now=now)


async def find(database, request, now=START):
    async with database.write() as tx:
        return await idempotency.find(tx, request, now=now)


async def test_same_request_gets_the_same_answer(database, request_):
    assert await find(database, request_) is None
    await remember(database, request_)
    assert await find(database, request_) == ANSWER


async def test_other_body_is_refused(database, request_):
    await remember(database, request_)
    with pytest.raises(KeyReusedError):
        await find(database, replace(request_, body_sha256="1" * 64))


@pytest.mark.parametrize("change", [{"token": "b"}, {"route": "other"}])
async def test_other_request_is_another(database, request_, change):
    await remember(database, request_)
    assert await find(database, replace(request_, **change)) is None


async def test_answers_are_kept_for_a_day(database, request_):
    await remember(database, request_)
    day = timedelta(hours=24)
    assert await find(database, request_, START + day - timedelta(seconds=1)) == ANSWER
    assert await find(database, request_, START + day) is None
    await remember(database, request_, START + day)
    await remember(database, replace(request_, token="b"), START + 3 * day)
    async with database.read() as tx:
        assert await tx.scalar(select(func.count()).select_from(IdempotencyRow)) == 1
