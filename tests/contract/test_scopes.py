"""Every route against every kind of key."""

import pytest
import pytest_asyncio

from app.domain.access import Scope
from tests.support import make_settings, run_service

pytestmark = pytest.mark.asyncio

PATHS = {
    "{user}": "ada",
    "{key}": "00000000-0000-0000-0000-000000000001",
    "{trial}": "00000000-0000-0000-0000-000000000001",
    "{job}": "00000000-0000-0000-0000-000000000001",
    "{number}": "1",
}
OPEN_ROUTES = {
    "GET /healthz",
    "GET /readyz",
    "GET /metrics",
    "GET /v1/skeletons",
    "GET /v1/limits",
    "GET /v1/quality",
    "POST /v1/viewer/redeem",
}
PREDICT_ROUTES = {
    "POST /v1/users/{user}/forecast",
    "GET /v1/users/{user}/versions",
    "GET /v1/users/{user}/versions/{number}",
}
RECORD_ROUTES = {
    "GET /v1/users/{user}/trials",
    "POST /v1/users/{user}/trials",
    "GET /v1/users/{user}/trials/{trial}",
    "DELETE /v1/users/{user}/trials/{trial}",
}


@pytest_asyncio.fixture
async def service(tmp_path):
    async with run_service(make_settings(tmp_path)) as running:
        await running.add_user("ada")
        await running.add_user("bob")
        yield running


def list_routes(service):
    """Every route of the OpenAPI document with the scope that it says it needs."""
    return [
        (method.upper(), path, operation["x-scope"])
        for path, operations in service.app.openapi()["paths"].items()
        for method, operation in operations.items()
    ]


def fill(path, user="ada"):
    for name, value in (PATHS | {"{user}": user}).items():
        path = path.replace(name, value)
    return path


async def test_documented_scopes_are_those_of_the_contract(service):
    scopes = {f"{method} {path}": scope for method, path, scope in list_routes(service)}
    assert {route for route, scope in scopes.items() if scope == "none"} == OPEN_ROUTES
    assert {route for route, scope in scopes.items() if scope == "predict"} == PREDICT_ROUTES
    assert {route for route, scope in scopes.items() if scope == "record"} == RECORD_ROUTES
    assert set(scopes.values()) == {"none", "predict", "record", "admin"}


async def test_open_routes_need_no_key_and_all_others_do(service):
    for method, path, scope in list_routes(service):
        answer = await service.call(method, fill(path), key=None)
        assert (answer.status_code == 401) == (scope != "none"), (method, path)


async def test_key_opens_exactly_the_routes_of_its_scopes(service):
    for given in (Scope.PREDICT, Scope.RECORD):
        key = (await service.add_key(given))["key"]
        for method, path, needed in list_routes(service):
            answer = await service.call(method, fill(path), key=key)
            refused = needed not in ("none", given)
            assert (answer.status_code == 403) == refused, (given, method, path, answer.text)


async def test_bound_key_is_refused_for_every_other_id_existing_or_not(service):
    key = (await service.add_key("predict", "record", user="ada"))["key"]
    for method, path, needed in list_routes(service):
        if needed not in ("predict", "record"):
            continue
        mine = await service.call(method, fill(path), key=key)
        assert mine.status_code not in (401, 403), (method, path)
        others = [
            await service.call(method, fill(path, user), key=key)
            for user in ("bob", "nobody", "Ada", "ada%20", "..ada")
        ]
        assert {answer.status_code for answer in others} == {403}, (method, path)
        assert len({answer.text for answer in others}) == 1  # nothing tells who exists


async def test_key_in_the_url_is_no_key(service):
    answer = await service.call("GET", "/v1/users?key=an-admin-key&api_key=x", key=None)
    assert answer.status_code == 401


@pytest.mark.parametrize("header", ["", "Bearer", "Bearer ", "Basic abc", "bearer\tx", "Bearer ä"])
async def test_malformed_authorization_is_unauthorized(service, header):
    answer = await service.client.get("/v1/users", headers={"Authorization": header.encode()})
    assert answer.status_code == 401


async def test_scheme_is_case_insensitive(service):
    from tests.support import ADMIN_KEY

    answer = await service.client.get("/v1/users", headers={"Authorization": f"bEARER {ADMIN_KEY}"})
    assert answer.status_code == 200
