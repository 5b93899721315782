"""A whole service in one test: a real database, a real engine, a forecaster without a big file."""

import os
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from uuid import uuid4

import httpx
import numpy as np
import psycopg
from fastapi import FastAPI
from sqlalchemy.engine import make_url

from app.live.decoders import Decoders
from app.main import create_app
from app.settings import Settings, load_settings
from app.storage.bootstrap import ensure_admin
from app.storage.database import Database
from app.storage.migrate import upgrade
from models.baselines import DampedVelocity
from models.data.synthetic import SyntheticPerson

POSTGRES_VARIABLE = "KINECAST_TEST_DATABASE_URL"
POSTGRES_DEFAULT = "postgresql+psycopg://root@127.0.0.1:5432/test"
ADMIN_KEY = "an-admin-key-that-only-tests-know-0123456789"
BASE_SHA256 = "0" * 64


def make_decoders() -> Decoders:
    """Weights that need no file: everybody glides to a halt."""
    return Decoders(DampedVelocity(15), base_sha256=BASE_SHA256)


def make_settings(data_dir: Path, **overrides: object) -> Settings:
    """Settings of a service in a folder of its own."""
    given: dict[str, Any] = {
        "data_dir": data_dir,
        "admin_key": ADMIN_KEY,
        "port": 0,
        "engine_batch": 4,
        "watch_s": 0.2,
    }
    return load_settings(**(given | overrides))


def find_postgres() -> str | None:
    """The address of a PostgreSQL to test with, None where none answers."""
    url = os.environ.get(POSTGRES_VARIABLE, POSTGRES_DEFAULT)
    try:
        _connect(url).close()
    except psycopg.OperationalError:
        return None
    return url


@contextmanager
def postgres_schema(url: str) -> Iterator[str]:
    """An address of a new, empty schema, which is dropped afterwards."""
    name = f"kinecast_{uuid4().hex}"
    with _connect(url) as connection:
        connection.execute(f'CREATE SCHEMA "{name}"')
    try:
        own = make_url(url).update_query_dict({"options": f"-csearch_path={name}"})
        yield own.render_as_string(hide_password=False)
    finally:
        with _connect(url) as connection:
            connection.execute(f'DROP SCHEMA "{name}" CASCADE')


def _connect(url: str) -> psycopg.Connection[Any]:
    plain = make_url(url).set(drivername="postgresql").render_as_string(hide_password=False)
    return psycopg.connect(plain, connect_timeout=2, autocommit=True)


@asynccontextmanager
async def open_database(settings: Settings) -> AsyncIterator[Database]:
    """A database with all its tables."""
    database = Database.from_settings(settings)
    try:
        await upgrade(database)
        yield database
    finally:
        await database.close()


@dataclass(frozen=True)
class Service:
    """A running service and a client of it."""

    app: FastAPI
    client: httpx.AsyncClient

    @property
    def database(self) -> Database:
        return self.app.state.database

    async def call(self, method: str, path: str, key: str | None = ADMIN_KEY, **body: Any):
        headers = {} if key is None else {"Authorization": f"Bearer {key}"}
        return await self.client.request(
            method, path, headers=headers | body.pop("headers", {}), **body
        )

    async def add_user(self, user: str = "ada", **fields: Any) -> dict[str, Any]:
        answer = await self.call("POST", "/v1/users", json={"id": user, **fields})
        assert answer.status_code == 201, answer.text
        return answer.json()

    async def add_key(self, *scopes: str, user: str | None = None) -> dict[str, Any]:
        body = {"scopes": list(scopes), "user": user}
        answer = await self.call("POST", "/v1/admin/keys", json=body)
        assert answer.status_code == 201, answer.text
        return answer.json()


@asynccontextmanager
async def run_service(settings: Settings, decoders: Decoders | None = None):
    """A service that is called in the process, without a socket."""
    async with open_database(settings) as database:
        await ensure_admin(database, settings)
    app = create_app(settings, decoders=decoders or make_decoders())
    transport = httpx.ASGITransport(app, raise_app_exceptions=False)
    async with (
        app.router.lifespan_context(app),
        httpx.AsyncClient(transport=transport, base_url="http://test") as client,
    ):
        yield Service(app, client)


def watch_person(seconds: float = 0.6, *, seed: int = 1, action: str = "wave") -> np.ndarray:
    """Frames of a believable person in the net's skeleton, 30 Hz, metres, y up."""
    return SyntheticPerson(seed).record(action, seconds).astype(np.float64)
