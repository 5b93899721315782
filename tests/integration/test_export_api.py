"""What a user may take along, and what is left when the user is erased."""

import io
import json
import tempfile
import threading
import zipfile
from contextlib import asynccontextmanager

import numpy as np
import pytest
from sqlalchemy import text

from app.api import export
from app.storage import trials, users
from tests.personal_support import claim, finish, record_frames
from tests.uploads import make_version, to_json, upload

pytestmark = pytest.mark.asyncio


async def test_erasing_a_user_erases_what_was_recorded(service):
    await service.add_user()
    await make_version(service)
    assert (await service.call("DELETE", "/v1/users/ada")).status_code == 204
    assert (await service.call("GET", "/v1/admin/jobs")).json()["items"] == []
    async with service.database.read() as tx:
        assert (await users.list_page(tx, after=None, limit=5)).items == []


async def test_export_holds_every_trial_version_and_decision(service):

    await service.add_user()
    frames = record_frames()
    await upload(service, to_json(frames))
    await finish(service.database, await claim(service.database), blob=b"one")
    await service.call("POST", "/v1/admin/users/ada/rollback", json={})
    answer = await service.call("GET", "/v1/users/ada/export")
    with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
        names = set(archive.namelist())
        tables = {n: json.loads(archive.read(n)) for n in names if n.endswith(".json")}
        (clip,) = (name for name in names if name.endswith(".npz"))
        with np.load(io.BytesIO(archive.read(clip)), allow_pickle=False) as arrays:
            assert np.array_equal(arrays["joints"], frames.joints)
            assert set(arrays) == {"t", "joints"}
        assert archive.read("versions/1.safetensors") == b"one"
    assert [line["kind"] for line in tables["activations.json"]] == ["promoted", "rolled_back"]
    assert [job["state"] for job in tables["jobs.json"]] == ["succeeded"]
    assert [version["state"] for version in tables["versions.json"]] == ["retired"]
    assert "version.rolled_back" in {event["action"] for event in tables["events.json"]}
    assert "uuid" not in tables["user.json"]


async def test_export_names_what_cannot_be_read_and_holds_the_rest(service):

    await service.add_user()
    for number, blob in enumerate((b"one", b"two", b"three")):
        await make_version(service, blob=blob, parent=number)
    async with service.database.write() as tx:
        for statement in (
            "UPDATE weights SET blob = :rot WHERE blob = :two",
            "UPDATE versions SET weights_sha256 = NULL WHERE number = 1",
            "UPDATE chunks SET payload = :rot "
            "WHERE trial_id = (SELECT trial_id FROM chunks LIMIT 1)",
        ):
            given = {"rot": b"x", "two": b"two"}
            named = {name: value for name, value in given.items() if f":{name}" in statement}
            await tx.execute(text(statement), named)
    answer = await service.call("GET", "/v1/users/ada/export")
    assert answer.status_code == 200
    with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
        names = set(archive.namelist())
        manifest = json.loads(archive.read("manifest.json"))
        assert archive.read("versions/3.safetensors") == b"three"
    assert names == {*manifest["files"], "manifest.json"}
    missing = {line["file"]: line["reason"] for line in manifest["missing"]}
    (clip,) = (name for name in missing if name.endswith(".npz"))
    assert missing == {
        clip: "damaged",
        "versions/1.safetensors": "weights_purged",
        "versions/2.safetensors": "weights_damaged",
    }
    assert not names & set(missing)
    assert len([name for name in names if name.endswith(".npz")]) == 2


async def test_export_lists_what_is_erased_meanwhile_as_missing(service, monkeypatch):
    await service.add_user()
    await make_version(service, blob=b"one")
    await make_version(service, blob=b"two", parent=1)
    listed = (await service.call("GET", "/v1/users/ada/trials")).json()["items"]
    newest, oldest = (trial["id"] for trial in listed)
    read_clips = trials.read_clips

    async def read(tx, trial_id):
        """Read clips, the first time while another trial is erased."""
        if str(trial_id) == oldest:
            await service.call("DELETE", f"/v1/users/ada/trials/{newest}")
        return await read_clips(tx, trial_id)

    monkeypatch.setattr(trials, "read_clips", read)
    answer = await service.call("GET", "/v1/users/ada/export")
    with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
        manifest = json.loads(archive.read("manifest.json"))
        assert {trial["id"] for trial in json.loads(archive.read("trials.json"))} == {
            newest,
            oldest,
        }
    assert f"trials/{oldest}/clip-000.npz" in manifest["files"]
    assert manifest["missing"] == [{"file": f"trials/{newest}/clip-000.npz", "reason": "erased"}]


async def test_export_is_written_beside_the_event_loop_and_in_short_transactions(
    sqlite_service, monkeypatch
):
    service = sqlite_service
    await service.add_user()
    await make_version(service)
    is_open, seen = False, []
    read = service.database.read
    write = zipfile.ZipFile.writestr

    @asynccontextmanager
    async def watch():
        nonlocal is_open
        async with read() as tx:
            is_open = True
            yield tx
        is_open = False

    def writestr(*given):
        seen.append((is_open, threading.current_thread() is threading.main_thread()))
        write(*given)

    monkeypatch.setattr(service.database, "read", watch)
    monkeypatch.setattr(zipfile.ZipFile, "writestr", writestr)
    assert (await service.call("GET", "/v1/users/ada/export")).status_code == 200
    assert len(seen) > 8
    assert set(seen) == {(False, False)}


async def test_export_that_fails_leaves_no_file_open(sqlite_service, monkeypatch):
    await sqlite_service.add_user()
    opened = []
    make = tempfile.SpooledTemporaryFile

    def remember(**given):
        opened.append(make(**given))
        return opened[-1]

    async def fail(*given):
        raise OSError("no space left")

    monkeypatch.setattr(export.tempfile, "SpooledTemporaryFile", remember)
    monkeypatch.setattr(trials, "list_all", fail)
    assert (await sqlite_service.call("GET", "/v1/users/ada/export")).status_code == 500
    assert [file.closed for file in opened] == [True]
