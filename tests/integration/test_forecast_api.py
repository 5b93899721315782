import asyncio
import json
import math
import threading

import msgspec
import numpy as np
import pytest
import pytest_asyncio

from app.api import forecast
from app.api.arrays import to_wire
from app.domain.body import measure_bones
from app.live.decoders import Decoders
from app.live.window import assemble
from models.baselines import DampedVelocity
from models.skeleton import SKELETONS
from tests.support import BASE_SHA256, Service, make_settings, run_service, watch_person
from tests.versions import add_version, make_net, make_net_decoders, make_personal

pytestmark = pytest.mark.asyncio
PATH = "/v1/users/ada/forecast"
MSGPACK = {"Content-Type": "application/msgpack"}


@pytest_asyncio.fixture
async def service(sqlite_settings):
    """A service with one user; what forecasts do does not depend on the database."""
    async with run_service(sqlite_settings) as running:
        await running.add_user()
        yield running


async def ask(service: Service, **body):
    answer = await service.call("POST", PATH, json=body)
    return answer.status_code, answer.json()


def read_array(sent):
    return np.frombuffer(sent["data"], sent["dtype"]).reshape(sent["shape"])


async def test_answer_is_what_the_contract_says(service):
    status, answer = await ask(service, frames=watch_person().tolist())
    assert status == 200
    frames = np.array(answer["frames"])
    assert frames.shape == (15, 20, 3)
    assert np.isfinite(frames).all()
    np.testing.assert_allclose(answer["t"], [(k + 1) / 30 for k in range(15)], atol=1e-9)
    assert answer["coverage"] == 0.9
    assert answer["version"] == {
        "number": 0,
        "kind": "base",
        "sha256": BASE_SHA256,
        "requested": "active",
        "share": 0.0,
        "fallback": None,
    }
    assert answer["radius"] is None
    assert answer["quality"] == ["uncalibrated"]
    assert (answer["severity"], answer["filled"]) == ("info", [])
    assert set(answer["timing"]) == {"queue_ms", "compute_ms", "total_ms"}
    assert all(ms >= 0 for ms in answer["timing"].values())


async def test_nothing_jumps_at_the_seam(service):
    poses = watch_person()
    _, answer = await ask(service, frames=poses.tolist())
    assert np.abs(np.array(answer["frames"])[0] - poses[-1]).max() < 0.1


async def test_epoch_of_the_clock_changes_nothing(service):
    poses = watch_person()
    t = np.arange(len(poses)) / 30
    answers = [
        (await ask(service, frames=poses.tolist(), t=(t + offset).tolist()))[1]
        for offset in (0.0, 1.7e9)
    ]
    np.testing.assert_allclose(answers[0]["frames"], answers[1]["frames"], atol=1e-4)
    np.testing.assert_allclose(np.array(answers[1]["t"]) - 1.7e9, answers[0]["t"], atol=1e-5)


async def test_both_formats_give_the_same_forecast(service):
    poses = watch_person()
    _, as_json = await ask(service, frames=poses.tolist(), t=(np.arange(len(poses)) / 30).tolist())
    body = {
        "frames": to_wire(poses, "<f8"),
        "t": to_wire(np.arange(len(poses)) / 30, "<f8"),
        "confidence": to_wire(np.ones(poses.shape[:2]), "<f4"),
    }
    answer = await service.call("POST", PATH, content=msgspec.msgpack.encode(body), headers=MSGPACK)
    assert answer.status_code == 200
    assert answer.headers["content-type"] == "application/msgpack"
    as_msgpack = msgspec.msgpack.decode(answer.content)
    assert as_msgpack["t"]["dtype"] == "<f8"
    np.testing.assert_allclose(read_array(as_msgpack["frames"]), as_json["frames"], atol=1e-5)
    np.testing.assert_allclose(read_array(as_msgpack["t"]), as_json["t"])
    assert as_msgpack["version"] == as_json["version"]


@pytest.mark.parametrize(
    ("sent", "accept", "received"),
    [
        ("json", "application/msgpack", "application/msgpack"),
        ("msgpack", "application/json", "application/json"),
        ("json", "text/html, */*", "application/json"),
        ("msgpack", "*/*", "application/msgpack"),
    ],
)
async def test_answer_has_the_format_that_is_asked_for(service, sent, accept, received):
    body = {"frames": watch_person().tolist()}
    encode = msgspec.json.encode if sent == "json" else msgspec.msgpack.encode
    headers = {"Content-Type": f"application/{sent}", "Accept": accept}
    answer = await service.call("POST", PATH, content=encode(body), headers=headers)
    assert answer.headers["content-type"] == received


@pytest.mark.parametrize("name", sorted(SKELETONS))
@pytest.mark.parametrize("up", ["y", "-y", "z"])
async def test_every_skeleton_comes_back_in_its_own_shape(service, name, up):
    skeleton = SKELETONS[name]
    await service.add_user("bob", skeleton=name, up=up)
    still = np.random.default_rng(3).normal(scale=0.3, size=(1, len(skeleton.joints), 3))
    poses = np.repeat(still, 16, axis=0)
    answer = await service.call("POST", "/v1/users/bob/forecast", json={"frames": poses.tolist()})
    assert answer.status_code == 200, answer.text
    np.testing.assert_allclose(answer.json()["frames"], poses[1:16], atol=1e-5)


async def test_missing_joints_are_filled_and_named(service):
    poses = watch_person().tolist()
    for frame in poses[-8:]:
        frame[0] = None
    status, answer = await ask(service, frames=poses)
    assert status == 200
    assert answer["filled"] == ["head"]
    assert "filled_joints" in answer["quality"]
    assert np.isfinite(answer["frames"]).all()


async def test_joint_of_low_confidence_counts_as_missing(service):
    poses = watch_person()
    confidence = np.ones(poses.shape[:2])
    confidence[-8:, 0] = 0.1
    _, answer = await ask(service, frames=poses.tolist(), confidence=confidence.tolist())
    assert answer["filled"] == ["head"]


@pytest.mark.parametrize("name", ["NaN", "Infinity", "-Infinity"])
async def test_nan_in_json_is_refused_with_a_hint(service, name):
    poses = watch_person().tolist()
    text = json.dumps({"frames": poses}).replace(str(poses[3][4][1]), name, 1)
    headers = {"Content-Type": "application/json"}
    answer = await service.call("POST", PATH, content=text, headers=headers)
    assert (answer.status_code, answer.json()["code"]) == (422, "nan_in_json")
    assert "null" in answer.json()["detail"]


async def test_nan_in_msgpack_is_a_missing_joint_and_infinity_is_refused(service):
    poses = watch_person()
    for value, status in ((math.nan, 200), (math.inf, 422)):
        poses[-8:, 0] = value
        body = msgspec.msgpack.encode({"frames": to_wire(poses, "<f4")})
        answer = await service.call("POST", PATH, content=body, headers=MSGPACK)
        assert answer.status_code == status


async def refused(service, code, status=422, **body):
    got, problem = await ask(service, **body)
    assert (got, problem["code"]) == (status, code), problem
    return problem


async def test_wrong_frames_are_refused_with_their_code(service):
    poses = watch_person()
    frames = poses.tolist()
    t = (np.arange(len(poses)) / 30).tolist()
    await refused(service, "too_little_history", frames=frames[:13])
    await refused(service, "person_lost", frames=[*frames, *[None] * 5])
    await refused(service, "wrong_joint_count", frames=poses[:, :19].tolist())
    await refused(service, "bad_frame", frames=(poses + 200).tolist())
    await refused(service, "t_not_increasing", frames=frames, t=t[::-1])
    await refused(service, "bad_time_unit", frames=frames, t=[1000 * s for s in t])
    await refused(service, "bad_frame", frames=frames, t=t[:-1])
    await refused(service, "bad_frame", frames=frames, confidence=[[1.0] * 19] * len(frames))
    await refused(service, "bad_frame", frames=frames, confidence=[[2.0] * 20] * len(frames))
    await refused(service, "version_unavailable", 409, frames=frames, version=1)


@pytest.mark.parametrize(
    ("change", "loc"),
    [
        ({"frames": "text"}, ["body", "frames"]),
        ({"t": "text"}, ["body", "t"]),
        ({"t": [None]}, ["body", "t", 0]),
        ({"coverage": 1}, ["body", "coverage"]),
        ({"coverage": "0.9"}, ["body", "coverage"]),
        ({"version": "newest"}, ["body", "version"]),
        ({"version": -1}, ["body", "version"]),
        ({"version": 1.5}, ["body", "version"]),
        ({"version": True}, ["body", "version"]),
        ({"version": None}, ["body", "version"]),
        ({"more": 1}, ["body", "more"]),
    ],
)
async def test_wrong_field_is_refused_with_its_place(service, change, loc):
    status, problem = await ask(service, **({"frames": watch_person().tolist()} | change))
    assert status == 422
    assert problem["errors"][0]["loc"] == loc


async def test_ragged_array_is_refused_with_its_place(service):
    frames = watch_person().tolist()
    frames[3].pop()
    problem = await refused(service, "invalid_request", frames=frames)
    assert problem["errors"][0]["loc"] == ["body", "frames", 3]
    frames = watch_person().tolist()
    frames[3][4][1] = "0.5"
    problem = await refused(service, "invalid_request", frames=frames)
    assert problem["errors"] == [
        {"loc": ["body", "frames", 3, 4, 1], "msg": "expected a number, got a text"}
    ]


async def test_too_many_frames_name_the_limit(service):
    problem = await refused(service, "limit_exceeded", frames=[None] * 601)
    assert problem["limit"] == "forecast_frames"
    body = msgspec.msgpack.encode({"frames": to_wire(np.zeros((601, 1, 3)), "<f4")})
    answer = await service.call("POST", PATH, content=body, headers=MSGPACK)
    assert answer.json()["code"] == "limit_exceeded"


async def test_most_frames_of_the_largest_skeleton_fit(service):
    await service.add_user("bob", skeleton="mediapipe")
    joints = len(SKELETONS["mediapipe"].joints)
    poses = np.random.default_rng(0).normal(size=(600, joints, 3)) * 1e-7 - 1 / 3
    body = {"frames": poses.tolist(), "confidence": [[0.98765432109876543] * joints] * 600}
    answer = await service.call("POST", "/v1/users/bob/forecast", json=body)
    assert answer.status_code == 200, answer.text


async def test_body_beyond_the_limit_is_refused_unread(service):
    headers = {"Content-Type": "application/json", "Content-Length": str(10**9)}
    answer = await service.call("POST", PATH, content=b"{}", headers=headers)
    assert (answer.status_code, answer.json()["code"]) == (413, "too_large")


@pytest.mark.parametrize(
    ("content", "media_type", "status"),
    [
        (b"{}", "text/plain", 415),
        (b"{}", "", 415),
        (b"{", "application/json", 400),
        (b"\xff", "application/json", 400),
        (b"[" * 20000, "application/json", 400),
        (b"[]", "application/json", 422),
        (b"\xc1", "application/msgpack", 400),
        (b"", "application/json", 400),
    ],
)
async def test_unreadable_body_is_refused(service, content, media_type, status):
    headers = {"Content-Type": media_type}
    answer = await service.call("POST", PATH, content=content, headers=headers)
    assert answer.status_code == status
    assert answer.headers["content-type"] == "application/problem+json"


async def test_unknown_user_is_not_found(service):
    answer = await service.call("POST", "/v1/users/nobody/forecast", json={"frames": []})
    assert (answer.status_code, answer.json()["code"]) == (404, "unknown_user")


async def test_many_at_once_get_the_forecast_that_one_gets(service):
    body = {"frames": watch_person().tolist()}
    _, alone = await ask(service, **body)
    together = await asyncio.gather(*(ask(service, **body) for _ in range(20)))
    for status, answer in together:
        assert status == 200
        np.testing.assert_allclose(answer["frames"], alone["frames"], atol=1e-4)


class Slow:
    """A base that forecasts, once it is told to, when it is let."""

    def __init__(self):
        self.waits, self.entered, self.release = (threading.Event() for _ in range(3))

    def __call__(self, window):
        if self.waits.is_set():
            self.entered.set()
            assert self.release.wait(10)
        return DampedVelocity(15)(window)


async def test_overload_is_answered_with_when_to_come_back(tmp_path):
    base = Slow()
    decoders = Decoders(base, base_sha256="0" * 64)
    async with run_service(make_settings(tmp_path, forecast_queue=1), decoders) as service:
        await service.add_user()
        body = {"frames": watch_person().tolist()}
        base.waits.set()
        first = asyncio.create_task(ask(service, **body))
        await asyncio.to_thread(base.entered.wait, 10)
        refusal = await service.call("POST", PATH, json=body)
        base.release.set()
        assert (await first)[0] == 200
    assert (refusal.status_code, refusal.json()["code"]) == (503, "overloaded")
    assert int(refusal.headers["retry-after"]) >= 1


@pytest.mark.parametrize(("scale", "seconds"), [(1.0, 1.2), (1.4, 1.2), (1.4, 0.9)])
async def test_the_base_answers_a_second_of_somebody_else(sqlite_settings, scale, seconds):
    base = make_net()
    mine = make_personal(base, 1, bones=measure_bones(watch_person(2.0)).tolist())
    async with run_service(sqlite_settings, make_net_decoders(base)) as service:
        await service.add_user()
        version = await add_version(service.database, "ada", mine)
        body = {"frames": (scale * watch_person(seconds)).tolist()}
        _, active = await ask(service, **body)
        _, pinned = await ask(service, **body, version=1)
    is_strange = scale > 1 and seconds > 1
    assert ("not_this_person" in active["quality"]) == is_strange
    assert active["version"]["fallback"] == ("guard" if is_strange else None)
    assert (active["version"]["sha256"] == version.sha256) == (not is_strange)
    assert ("not_this_person" in pinned["quality"]) == is_strange
    assert pinned["version"]["sha256"] == version.sha256  # flagged, never replaced


async def test_many_frames_are_put_together_beside_the_event_loop(service, monkeypatch):
    threads = []

    def note(*arguments, **options):
        threads.append(threading.current_thread())
        return assemble(*arguments, **options)

    monkeypatch.setattr(forecast, "assemble", note)
    for seconds in (0.6, 20.0):
        status, _ = await ask(service, frames=watch_person(seconds).tolist())
        assert status == 200
    assert threads[0] is threading.current_thread()
    assert threads[1] is not threads[0]
    answer = await service.call("POST", PATH, json={"frames": [[[0.0, 0.0, 0.0]]] * 90})
    assert answer.json()["code"] == "wrong_joint_count"
