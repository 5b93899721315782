"""What a user may take along, and what is left when the user is erased."""

import io
import json
import zipfile

import numpy as np
import pytest
from sqlalchemy import text

from app.storage import users
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
