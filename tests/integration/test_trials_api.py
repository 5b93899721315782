"""Trials over HTTP, in every format; versions and jobs as an operator sees them."""

import asyncio
import io
from uuid import UUID

import msgspec
import numpy as np
import pytest

from app.domain.recordings import unpack_frames
from app.storage import trials
from tests.personal_support import record_frames
from tests.support import make_settings, run_service
from tests.uploads import TRIALS, to_json, to_msgpack, upload

pytestmark = pytest.mark.asyncio
MSGPACK = {"Content-Type": "application/msgpack", "Accept": "application/json"}


async def read_stored(service, trial_id):
    async with service.database.read() as tx:
        found = await trials.read_clips(tx, UUID(trial_id))
    return [unpack_frames(clip.chunks) for clip in found]


async def test_trial_is_stored_as_received_and_gets_a_job(service):
    await service.add_user()
    frames = record_frames()
    answer = await upload(service, to_json(frames), label="monday")
    assert answer.status_code == 202, answer.text
    trial, job = answer.json()["trial"], answer.json()["job"]
    assert (trial["state"], trial["clips"], trial["frames"]) == ("stored", 1, len(frames))
    assert (trial["label"], trial["user"], trial["seconds"]) == ("monday", "ada", 1.967)
    assert (job["state"], job["reason"], job["trials"]) == ("queued", "trial", None)
    (stored,) = await read_stored(service, trial["id"])
    assert np.array_equal(stored.joints, frames.joints)
    assert stored.t[-1] == 0.0
    listed = (await service.call("GET", TRIALS)).json()["items"]
    one = (await service.call("GET", f"{TRIALS}/{trial['id']}")).json()
    assert listed == [trial] == [one]


async def test_trials_join_the_job_that_waits(service):
    await service.add_user()
    answers = [(await upload(service, to_json(record_frames()))).json() for _ in range(2)]
    assert answers[0]["job"]["id"] == answers[1]["job"]["id"]
    quiet = (await upload(service, to_json(record_frames()), finetune=False)).json()
    assert quiet["job"] is None


async def test_msgpack_keeps_missing_joints_and_late_times(service):
    await service.add_user()
    frames = record_frames()
    frames.joints[5:7, 3] = np.nan
    frames = type(frames)(t=frames.t + 1.7e9, joints=frames.joints)
    body = msgspec.msgpack.encode({"clips": [to_msgpack(frames)]})
    answer = await service.call("POST", TRIALS, content=body, headers=MSGPACK)
    assert answer.status_code == 202, answer.text
    (stored,) = await read_stored(service, answer.json()["trial"]["id"])
    assert stored.t.tobytes() == frames.t.tobytes()
    assert stored.joints.tobytes() == frames.joints.tobytes()
    plain = await service.call(
        "POST", TRIALS, content=body, headers={"Content-Type": "application/msgpack"}
    )
    assert msgspec.msgpack.decode(plain.content)["trial"]["clips"] == 1


async def test_large_bodies_are_read_elsewhere_with_the_same_result(service):
    await service.add_user()
    clips = [to_json(record_frames(4.0, seed=i)) for i in range(4)]
    answer = await upload(service, *clips)
    assert len(answer.request.content) > 131_072
    assert answer.status_code == 202, answer.text
    assert answer.json()["trial"]["clips"] == 4
    clips[3]["frames"][5][2] = [0, 0]
    wrong = await upload(service, *clips)
    assert wrong.status_code == 422
    assert wrong.json()["errors"][0]["loc"] == ["body", "clips", 3, "frames", 5, 2]


async def test_short_and_wrong_clips_are_stored_unused_and_reported(service):
    await service.add_user()
    good = record_frames()
    short = {"frames": good.joints[:29].tolist()}
    frozen = {"frames": [good.joints[0].tolist()] * 40}
    answer = await upload(service, to_json(good), short, frozen)
    trial = answer.json()["trial"]
    assert (trial["clips"], trial["clips_unused"]) == (3, 2)
    assert [clip["reason"] for clip in trial["details"]] == [None, "too_short", "frozen_input"]
    assert [clip["used"] for clip in trial["details"]] == [True, False, False]
    assert all(clip["message"] for clip in trial["details"][1:])
    assert len(await read_stored(service, trial["id"])) == 3


async def test_same_idempotency_key_stores_once(service):
    await service.add_user()
    headers = {"Idempotency-Key": "one"}
    clip = to_json(record_frames())
    answers = await asyncio.gather(*(upload(service, clip, headers=headers) for _ in range(3)))
    assert len({answer.text for answer in answers}) == 1
    assert len((await service.call("GET", TRIALS)).json()["items"]) == 1
    other = await upload(service, clip, headers=headers, label="x")
    assert (other.status_code, other.json()["code"]) == (422, "idempotency_key_reused")
    again = await upload(service, clip, headers={"Idempotency-Key": "two"})
    assert again.json()["trial"]["id"] != answers[0].json()["trial"]["id"]


@pytest.mark.parametrize(
    ("body", "code"),
    [
        ({"clips": []}, "invalid_request"),
        ({}, "invalid_request"),
        ({"clips": [{}]}, "invalid_request"),
        ({"clips": [{"frames": [[[0, 0, 0]]]}]}, "wrong_joint_count"),
        ({"clips": [{"frames": [[[0, 0, 999]] * 20]}]}, "bad_frame"),
        ({"clips": [{"frames": [[None] * 20] * 2, "t": [1.0]}]}, "bad_frame"),
        ({"clips": [{"frames": [[None] * 20] * 2, "t": [1.0, 1.0]}]}, "t_not_increasing"),
        ({"clips": [{"frames": [[None] * 20], "speed": 1}]}, "unknown_field"),
        ({"clips": [{"frames": [None] * 9001}]}, "limit_exceeded"),
        ({"clips": [{}] * 501}, "limit_exceeded"),
    ],
)
async def test_wrong_trial_is_refused(service, body, code):
    await service.add_user()
    answer = await service.call("POST", TRIALS, json=body)
    assert (answer.status_code, answer.json()["code"]) == (422, code), answer.text
    assert (await service.call("GET", TRIALS)).json()["items"] == []


def write_npz(frames, subjects=("1",), action="wave"):
    count = len(subjects)
    buffer = io.BytesIO()
    np.savez(
        buffer,
        frames=np.concatenate([frames.joints[:0], *[frames.joints] * count]),
        lengths=np.array([len(frames)] * count, dtype=np.int64),
        subject=np.array(subjects, dtype=np.str_),
        action=np.array([action] * count, dtype=np.str_),
        trial=np.array(["1"] * count, dtype=np.str_),
        rate_hz=np.float64(30.0),
    )
    return buffer.getvalue()


def write_csv(frames, action="wave"):
    from models.skeleton import KINECT_V1

    names = [f"{joint}.{axis}" for joint in KINECT_V1.joints for axis in "xyz"]
    lines = [",".join(["t", "action", *names])]
    for t, pose in zip(frames.t, frames.joints, strict=True):
        numbers = ["" if np.isnan(x) else repr(float(x)) for x in pose.ravel()]
        lines.append(",".join([repr(float(t)), action, *numbers]))
    return "\n".join(lines).encode()


def write_mat(frames):
    import scipy.io

    buffer = io.BytesIO()
    scipy.io.savemat(buffer, {"d_skel": frames.joints.transpose(1, 2, 0).astype(np.float64)})
    return buffer.getvalue()


async def send_files(service, *files, **fields):
    parts = [("file", (name, content, "application/octet-stream")) for name, content in files]
    return await service.call("POST", TRIALS, files=parts, data=fields)


async def test_files_of_every_kind_are_read(service):
    await service.add_user()
    frames = record_frames()
    frames.joints[3, 7] = np.nan
    whole = record_frames()
    answer = await send_files(
        service,
        ("a1_s2_t1_skeleton.mat", write_mat(whole)),
        ("more.npz", write_npz(whole)),
        ("own.csv", write_csv(frames)),
        label="files",
        finetune="false",
    )
    assert answer.status_code == 202, answer.text
    trial = answer.json()["trial"]
    assert (trial["label"], answer.json()["job"]) == ("files", None)
    assert [clip["action"] for clip in trial["details"]] == ["1", "wave", "wave"]
    mat, npz, table = await read_stored(service, trial["id"])
    assert np.array_equal(mat.joints, whole.joints)
    assert np.array_equal(npz.joints, whole.joints)
    assert np.array_equal(table.joints, frames.joints, equal_nan=True)
    assert np.array_equal(table.t, frames.t)


@pytest.mark.parametrize(
    ("name", "content", "word"),
    [
        ("a.mat", b"nonsense", "MATLAB"),
        ("a.npz", b"nonsense", "npz"),
        ("a.csv", b"a,b\n1,2\n", "head.x"),
        ("a.csv", b"\xff\xfe", "UTF-8"),
        ("a.csv", b"", "it is empty"),
        ("a.csv", b"\xef\xbb\xbf\n", "it is empty"),
        ("a.exe", b"", ".mat"),
    ],
)
async def test_file_that_cannot_be_read_is_named(sqlite_service, name, content, word):
    await sqlite_service.add_user()
    answer = await send_files(sqlite_service, (name, content))
    assert (answer.status_code, answer.json()["code"]) == (422, "bad_recording")
    assert name in answer.json()["detail"]
    assert word in answer.json()["detail"]
    assert "upload.npz" not in answer.text


async def test_file_of_several_people_is_refused(sqlite_service):
    await sqlite_service.add_user()
    answer = await send_files(sqlite_service, ("a.npz", write_npz(record_frames(), ("1", "2"))))
    assert "several people (1, 2)" in answer.json()["detail"]


async def test_file_without_a_frame_is_told_so(sqlite_service):
    await sqlite_service.add_user()
    header = write_csv(record_frames()).partition(b"\n")[0]
    answer = await send_files(sqlite_service, ("a.csv", header))
    assert (answer.status_code, answer.json()["code"]) == (422, "bad_recording")
    assert answer.json()["detail"] == "a.csv: it has no frames, only the names of columns."
    nothing = await send_files(sqlite_service, ("a.npz", write_npz(record_frames(), ())))
    assert nothing.json()["detail"] == "a.npz: it has no clips."


@pytest.mark.parametrize("action", ["x" * 201, "a\x85b"])
async def test_actions_of_files_obey_the_rule_of_json(sqlite_service, action):
    await sqlite_service.add_user()
    frames = record_frames()
    for name, content in (
        ("a.csv", write_csv(frames, action=action)),
        ("a.npz", write_npz(frames, action=action)),
    ):
        answer = await send_files(sqlite_service, (name, content))
        assert (answer.status_code, answer.json()["code"]) == (422, "bad_recording")
        assert f"{name}, clip 0: The action must be 1 to 200" in answer.json()["detail"]


async def test_only_the_name_of_a_file_is_cut_to_name_an_action(sqlite_service):
    await sqlite_service.add_user()
    answer = await send_files(sqlite_service, ("x" * 210 + ".mat", write_mat(record_frames())))
    (clip,) = answer.json()["trial"]["details"]
    assert clip["action"] == "x" * 200


async def test_a_clip_without_frames_is_refused_in_either_format(sqlite_service):
    await sqlite_service.add_user()
    empty = record_frames()
    empty = type(empty)(t=empty.t[:0], joints=empty.joints[:0])
    body = msgspec.msgpack.encode({"clips": [to_msgpack(empty)]})
    for sent in (
        {"content": body, "headers": MSGPACK},
        {"json": {"clips": [{"frames": [], "t": []}]}},
    ):
        answer = await sqlite_service.call("POST", TRIALS, **sent)
        assert answer.status_code == 422
        (wrong,) = answer.json()["errors"]
        assert wrong["loc"] == ["body", "clips", 0, "frames"]
        assert "there must be a frame with joints" in wrong["msg"]


async def test_upload_that_takes_too_long_is_refused(tmp_path):
    settings = make_settings(tmp_path, parse_timeout_s=0.05)
    async with run_service(settings) as service:
        await service.add_user()
        answer = await send_files(service, ("a.npz", write_npz(record_frames())))
        assert (answer.status_code, answer.json()["code"]) == (422, "bad_recording")
        assert "timed out" in answer.json()["detail"]


async def test_erased_trial_is_gone(service):
    await service.add_user()
    trial = (await upload(service, to_json(record_frames()))).json()["trial"]["id"]
    assert (await service.call("DELETE", f"{TRIALS}/{trial}")).status_code == 204
    for method in ("GET", "DELETE"):
        answer = await service.call(method, f"{TRIALS}/{trial}")
        assert (answer.status_code, answer.json()["code"]) == (404, "unknown_trial")


async def test_nobody_sees_the_trials_of_somebody_else(service):
    await service.add_user()
    await service.add_user("bob")
    trial = (await upload(service, to_json(record_frames()))).json()["trial"]["id"]
    answer = await service.call("GET", f"/v1/users/bob/trials/{trial}")
    assert answer.status_code == 404


@pytest.mark.parametrize("label", ["a\x00b", "x" * 201, "\n", "a\x85b"])
async def test_labels_of_forms_obey_the_rule_of_json(service, label):
    await service.add_user()
    answer = await send_files(service, ("own.csv", write_csv(record_frames())), label=label)
    assert (answer.status_code, answer.json()["code"]) == (422, "invalid_request")
    assert "label" in answer.json()["detail"]
