"""What closing a pool leaves behind."""

import asyncio
import threading
from pathlib import Path

import pytest
from sqlalchemy import text

from app.storage.database import Database
from tests.support import make_settings


def test_statements_that_are_called_off_have_ended_when_the_pool_is_closed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    failed: list[object] = []
    monkeypatch.setattr(threading, "excepthook", failed.append)
    slow = text(
        "WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x+1 FROM c WHERE x<400000)"
        " SELECT count(*) FROM c"
    )

    async def leave() -> None:
        database = Database.from_settings(make_settings(tmp_path))

        async def work() -> None:
            async with database.read() as tx:
                await tx.execute(slow)

        tasks = [asyncio.create_task(work()) for _ in range(3)]
        await asyncio.sleep(0.02)
        for task in tasks:
            task.cancel()
        await database.close()

    for _ in range(3):
        asyncio.run(leave())
    assert not [one for one in threading.enumerate() if "_connection_worker_thread" in one.name]
    assert failed == []
