"""Versions and jobs over HTTP, as an operator sees them."""

import asyncio
from uuid import UUID

import msgspec
import pytest

from tests.personal_support import claim, finish, record_frames
from tests.uploads import make_version, to_json, upload

pytestmark = pytest.mark.asyncio


async def test_versions_are_listed_downloaded_promoted_and_rolled_back(service):
    await service.add_user()
    await make_version(service, blob=b"one")
    (shown,) = (await service.call("GET", "/v1/users/ada/versions")).json()["items"]
    assert (shown["number"], shown["state"], shown["bytes"]) == (1, "active", 3)
    assert shown == (await service.call("GET", "/v1/users/ada/versions/1")).json()
    user = (await service.call("GET", "/v1/users/ada")).json()
    assert user["version"]["sha256"] == shown["sha256"]
    assert (user["version"]["kind"], user["auto_promote"]) == ("personal", True)
    assert user["version"]["share"] == 1.0
    path = "/v1/users/ada/versions/1/weights"
    download = await service.call("GET", path)
    assert (download.content, download.headers["etag"]) == (b"one", f'"{shown["sha256"]}"')
    for etag in (download.headers["etag"], f'"x", W/{download.headers["etag"]}', "*"):
        cached = await service.call("GET", path, headers={"If-None-Match": etag})
        assert (cached.status_code, cached.content) == (304, b"")
    rolled = await service.call("POST", "/v1/admin/users/ada/rollback", json={})
    assert (rolled.status_code, rolled.json()["number"], rolled.json()["share"]) == (200, 0, 0.0)
    stale = await service.call(
        "POST",
        "/v1/admin/users/ada/versions/1/promote",
        json={"active_sha256": shown["sha256"]},
    )
    assert (stale.status_code, stale.json()["code"]) == (409, "active_changed")
    promoted = await service.call("POST", "/v1/admin/users/ada/versions/1/promote", json={})
    assert (promoted.json()["number"], promoted.json()["share"]) == (1, 1.0)
    user = (await service.call("GET", "/v1/users/ada")).json()
    assert user["auto_promote"] is False
    patched = await service.call("PATCH", "/v1/users/ada", json={"auto_promote": True})
    assert patched.json()["auto_promote"] is True
    missing = await service.call("GET", "/v1/users/ada/versions/2")
    assert (missing.status_code, missing.json()["code"]) == (404, "unknown_version")


async def test_promotion_and_rollback_need_no_body(service):
    await service.add_user()
    await make_version(service, blob=b"one")
    rollback, promote = (f"/v1/admin/users/ada/{end}" for end in ("rollback", "versions/1/promote"))
    rolled = await service.call("POST", rollback)
    assert (rolled.status_code, rolled.json()["number"]) == (200, 0)
    form = {"Content-Type": "application/x-www-form-urlencoded"}  # what curl says with -d ''
    promoted = await service.call("POST", promote, headers=form)
    assert (promoted.status_code, promoted.json()["number"]) == (200, 1)
    for path in (rollback, promote):
        other = await service.call("POST", path, content=b"a=b", headers=form)
        assert (other.status_code, other.json()["code"]) == (415, "unsupported_media_type")
    assert (await service.call("POST", rollback, json={"sha": "9f"})).status_code == 422


async def test_purged_weights_are_gone_and_damaged_ones_are_not_handed_out(service):
    from sqlalchemy import text

    await service.add_user()
    await make_version(service, blob=b"one")
    async with service.database.write() as tx:
        await tx.execute(text("UPDATE weights SET blob = :blob"), {"blob": b"two"})
    path = "/v1/users/ada/versions/1/weights"
    damaged = await service.call("GET", path)
    assert (damaged.status_code, damaged.json()["code"]) == (410, "weights_damaged")
    assert damaged.headers["content-type"] == "application/problem+json"
    async with service.database.write() as tx:
        await tx.execute(text("UPDATE versions SET weights_sha256 = NULL"))
        await tx.execute(text("DELETE FROM weights"))
    sha256 = (await service.call("GET", "/v1/users/ada/versions/1")).json()["sha256"]
    for headers in ({}, {"If-None-Match": f'"{sha256}"'}):
        purged = await service.call("GET", path, headers=headers)
        assert (purged.status_code, purged.json()["code"]) == (410, "weights_purged")


async def test_admin_asks_for_fine_tuning_and_calls_it_off(service):
    await service.add_user()
    path = "/v1/admin/users/ada/finetune"
    nothing = await service.call("POST", path, json={})
    assert (nothing.status_code, nothing.json()["code"]) == (422, "nothing_to_train_on")
    trial = (await upload(service, to_json(record_frames()), finetune=False)).json()["trial"]["id"]
    chosen = await service.call("POST", path, json={"trials": [trial]})
    assert (chosen.status_code, chosen.json()["trials"]) == (202, [trial])
    again = await service.call("POST", path, json={"trials": [trial]})
    assert (again.status_code, again.json()["code"]) == (409, "job_queued")
    unknown = await service.call("POST", path, json={"trials": [str(UUID(int=1))]})
    assert unknown.status_code == 404
    job = chosen.json()["id"]
    listed = (await service.call("GET", "/v1/admin/jobs?user=ada&state=queued")).json()["items"]
    assert [item["id"] for item in listed] == [job]
    cancelled = await service.call("POST", f"/v1/admin/jobs/{job}/cancel")
    assert cancelled.json()["state"] == "cancelled"
    assert (await service.call("GET", f"/v1/admin/jobs/{job}")).json()["state"] == "cancelled"


@pytest.mark.parametrize("user", ["bob", "%00", "a%2Fb", "", "x" * 65])
async def test_nobody_has_no_jobs(service, user):
    await service.add_user()
    await upload(service, to_json(record_frames()))
    answer = await service.call("GET", f"/v1/admin/jobs?user={user}")
    assert (answer.status_code, answer.json()) == (200, {"items": [], "next_cursor": None})


async def test_changes_of_a_job_are_told_until_its_end(service):
    await service.add_user()
    job = (await upload(service, to_json(record_frames()))).json()["job"]["id"]

    async def work():
        held = await claim(service.database)
        await asyncio.sleep(0.7)
        await finish(service.database, held)

    worker = asyncio.create_task(work())
    answer = await service.call("GET", f"/v1/admin/jobs/{job}/events", timeout=20)
    await worker
    assert answer.headers["content-type"].startswith("text/event-stream")
    told = [
        msgspec.json.decode(line.removeprefix("data: "))["state"]
        for line in answer.text.splitlines()
        if line.startswith("data: ")
    ]
    assert told[-1] == "succeeded"
    assert told in (["queued", "running", "succeeded"], ["running", "succeeded"])
