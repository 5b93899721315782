"""A service as users run it: `kinecast serve` in a process of its own, on a free port."""

from collections.abc import Iterator

import httpx
import pytest

from app.commands.own_server import OwnServer, run_own_server


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[OwnServer]:
    with run_own_server(tmp_path_factory.mktemp("service")) as server:
        yield server


def call(
    server: OwnServer, method: str, path: str, key: str | None = None, **body
) -> httpx.Response:
    headers = {"Authorization": f"Bearer {server.key if key is None else key}"}
    url = server.url + path
    return httpx.request(method, url, headers=headers | body.pop("headers", {}), timeout=20, **body)


def add_user(server: OwnServer, user: str) -> str:
    answer = call(server, "POST", "/v1/users", json={"id": user})
    assert answer.status_code == 201, answer.text
    return user


def add_key(server: OwnServer, *scopes: str, user: str | None = None) -> str:
    answer = call(server, "POST", "/v1/admin/keys", json={"scopes": list(scopes), "user": user})
    assert answer.status_code == 201, answer.text
    return answer.json()["key"]
