import io
import json
import zipfile
from uuid import UUID

import pytest

from tests.support import make_settings, run_service

pytestmark = pytest.mark.asyncio


async def test_user_is_added_with_defaults_and_found(service):
    made = await service.call("POST", "/v1/users", json={"id": "ada"})
    assert made.status_code == 201
    assert made.headers["location"] == "/v1/users/ada"
    user = made.json()
    assert user == (await service.call("GET", "/v1/users/ada")).json()
    assert {name: user[name] for name in ("id", "skeleton", "up", "root_relative")} == {
        "id": "ada",
        "skeleton": "kinect_v1",
        "up": "y",
        "root_relative": False,
    }
    assert user["created_at"].endswith("Z")
    assert user["version"]["number"] == 0
    assert user["version"]["kind"] == "base"
    assert "uuid" not in user


async def test_sensor_without_a_global_position_makes_the_user_root_relative(service):
    assert (await service.add_user(skeleton="mediapipe"))["root_relative"] is True


@pytest.mark.parametrize(
    ("body", "loc"),
    [
        ({}, ["body", "id"]),
        ({"id": ""}, ["body", "id"]),
        ({"id": "-ada"}, ["body", "id"]),
        ({"id": "a" * 65}, ["body", "id"]),
        ({"id": "a/b"}, ["body", "id"]),
        ({"id": "ada\n"}, ["body", "id"]),
        ({"id": "ada", "skeleton": "octopus"}, ["body"]),
        ({"id": "ada", "up": "x"}, ["body", "up"]),
        ({"id": "ada", "display_name": "\u0000"}, ["body", "display_name"]),
        ({"id": "ada", "display_name": "a" * 201}, ["body", "display_name"]),
    ],
)
async def test_wrong_user_is_refused_with_the_place(service, body, loc):
    answer = await service.call("POST", "/v1/users", json=body)
    assert answer.status_code == 422
    assert [error["loc"] for error in answer.json()["errors"]] == [loc]


async def test_unknown_field_is_refused(service):
    answer = await service.call("POST", "/v1/users", json={"id": "ada", "hieght": 1.8})
    assert (answer.status_code, answer.json()["code"]) == (422, "unknown_field")


async def test_taken_id_is_a_conflict(service):
    await service.add_user()
    answer = await service.call("POST", "/v1/users", json={"id": "ada"})
    assert (answer.status_code, answer.json()["code"]) == (409, "user_exists")


async def test_list_pages_newest_first(service):
    for i in range(5):
        await service.add_user(f"user-{i}")
    first = (await service.call("GET", "/v1/users?limit=3")).json()
    second = (
        await service.call("GET", "/v1/users", params={"limit": 3, "cursor": first["next_cursor"]})
    ).json()
    names = [user["id"] for user in first["items"] + second["items"]]
    assert names == [f"user-{i}" for i in (4, 3, 2, 1, 0)]
    assert second["next_cursor"] is None


@pytest.mark.parametrize("query", ["limit=0", "limit=201", "limit=x", "cursor=nonsense"])
async def test_wrong_page_is_refused(service, query):
    assert (await service.call("GET", f"/v1/users?{query}")).status_code == 422


async def test_name_changes_and_goes(service):
    await service.add_user()
    for body, name in (
        ({"display_name": "Ada"}, "Ada"),
        ({}, "Ada"),
        ({"display_name": None}, None),
    ):
        answer = await service.call("PATCH", "/v1/users/ada", json=body)
        assert (answer.status_code, answer.json()["display_name"]) == (200, name)


async def test_skeleton_cannot_be_changed(service):
    await service.add_user()
    answer = await service.call("PATCH", "/v1/users/ada", json={"skeleton": "coco17"})
    assert answer.json()["code"] == "unknown_field"


async def test_erased_user_is_gone_with_their_keys(service):
    await service.add_user()
    key = (await service.add_key("predict", user="ada"))["key"]
    assert (await service.call("DELETE", "/v1/users/ada")).status_code == 204
    assert (await service.call("GET", "/v1/users/ada")).status_code == 404
    assert (await service.call("DELETE", "/v1/users/ada")).status_code == 404
    forecast = await service.call("POST", "/v1/users/ada/forecast", key=key, json={})
    assert forecast.status_code == 401


async def test_erased_user_is_in_no_file_any_more(tmp_path):
    async with run_service(make_settings(tmp_path)) as service:
        await service.add_user("somebody-unforgettable", display_name="Unforgettable Name")
        files = list(tmp_path.glob("kinecast.sqlite3*"))
        assert any(b"nforgettable" in path.read_bytes() for path in files)
        await service.call("DELETE", "/v1/users/somebody-unforgettable")
        assert not any(b"nforgettable" in path.read_bytes() for path in files)


async def test_export_holds_the_user_and_what_was_done(service):
    await service.add_user(display_name="Ada")
    await service.call("PATCH", "/v1/users/ada", json={"display_name": "Ada L."})
    answer = await service.call("GET", "/v1/users/ada/export")
    assert answer.headers["content-type"] == "application/zip"
    with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
        files = {name: json.loads(archive.read(name)) for name in archive.namelist()}
    assert files["user.json"]["display_name"] == "Ada L."
    actions = [event["action"] for event in files["events.json"]]
    assert actions == ["user.created", "user.changed", "user.exported"]


async def test_key_is_shown_once_and_works_until_revoked(service):
    await service.add_user()
    made = await service.add_key("predict", user="ada")
    assert made["scopes"] == ["predict"]
    listed = (await service.call("GET", "/v1/admin/keys")).json()["items"]
    mine = next(key for key in listed if key["id"] == made["id"])
    assert "key" not in mine
    assert made["key"].split("_")[2] not in json.dumps(listed)
    path = "/v1/users/ada/forecast"
    assert (await service.call("POST", path, key=made["key"], json={})).status_code == 422
    assert (await service.call("DELETE", f"/v1/admin/keys/{made['id']}")).status_code == 204
    assert (await service.call("POST", path, key=made["key"], json={})).status_code == 401
    listed = (await service.call("GET", "/v1/admin/keys")).json()["items"]
    assert next(key for key in listed if key["id"] == made["id"])["revoked_at"] is not None


@pytest.mark.parametrize(
    ("body", "status"),
    [
        ({"scopes": []}, 422),
        ({"scopes": ["fly"]}, 422),
        ({"scopes": ["admin"], "user": "ada"}, 422),
        ({"scopes": ["predict"], "user": "nobody"}, 404),
        ({}, 422),
    ],
)
async def test_wrong_key_is_refused(service, body, status):
    await service.add_user()
    assert (await service.call("POST", "/v1/admin/keys", json=body)).status_code == status


async def test_revoking_nothing_is_an_error(service):
    missing = await service.call("DELETE", f"/v1/admin/keys/{UUID(int=7)}")
    assert (missing.status_code, missing.json()["code"]) == (404, "unknown_key")
    assert (await service.call("DELETE", "/v1/admin/keys/7")).status_code == 422
