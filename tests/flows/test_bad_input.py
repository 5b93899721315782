"""What a service does with bad input: the contract's error, and it goes on where it can."""

import asyncio
import http.client
import json
import math
import socket
import time
from contextlib import asynccontextmanager, suppress

import httpx
import msgspec
import numpy as np
import pytest
import websockets
from websockets.frames import Frame, Opcode

from app.commands.client.errors import ClosedError
from app.commands.client.messages import JSON, MSGPACK, Error, Forecast, Message, Other, Pong
from app.commands.client.stream import Stream, find_stream_url, open_stream
from tests.flows.conftest import add_key, add_user, call
from tests.support import watch_person

PERSON = watch_person(3.0)
GOOD = PERSON[:15].tolist()
JSON_TYPE = {"Content-Type": "application/json"}
MSGPACK_TYPE = {"Content-Type": "application/msgpack"}
NOBODYS_KEY = "kc_" + "0" * 32 + "_" + "a" * 43


def swap(frames: list, frame: int, joint: int, value: object) -> list:
    """A copy with another joint."""
    copy = [list(pose) for pose in frames]
    copy[frame][joint] = value
    return copy


def raw_json(frames: object) -> bytes:
    """JSON as lax encoders write it, with NaN and Infinity."""
    return json.dumps({"frames": frames}).encode()


BAD_BODIES = {
    "fewer than 15 frames": ({"frames": GOOD[:13]}, 422, "too_little_history"),
    "no frames": ({"frames": []}, 422, "invalid_request"),
    "wrong joint count": ({"frames": [pose[:19] for pose in GOOD]}, 422, "wrong_joint_count"),
    "strings": ({"frames": swap(GOOD, 3, 4, ["a", "b", "c"])}, 422, "invalid_request"),
    "text": ({"frames": "frames"}, 422, "invalid_request"),
    "ragged joints": ({"frames": swap(GOOD, 3, 4, [0.0, 1.0])}, 422, "invalid_request"),
    "ragged frames": ({"frames": [*GOOD[:14], GOOD[14][:12]]}, 422, "invalid_request"),
    "far too large": ({"frames": swap(GOOD, 3, 4, [0.0, 0.0, 1e9])}, 422, "bad_frame"),
    "t going back": (
        {"frames": GOOD, "t": [*(k / 30 for k in range(14)), 0.1]},
        422,
        "t_not_increasing",
    ),
    "t of milliseconds": (
        {"frames": GOOD, "t": [k * 33.3 for k in range(15)]},
        422,
        "bad_time_unit",
    ),
    "an unknown field": ({"frames": GOOD, "frame": 1}, 422, "unknown_field"),
    "a version that is not there": ({"frames": GOOD, "version": 7}, 409, "version_unavailable"),
    "too many frames": ({"frames": GOOD * 41}, 422, "limit_exceeded"),
}


@pytest.fixture(scope="module")
def user(served) -> str:
    return add_user(served, "ada")


def forecast(served, user, key=None, **body) -> httpx.Response:
    return call(served, "POST", f"/v1/users/{user}/forecast", key, **body)


def assert_problem(answer: httpx.Response, status: int, code: str) -> None:
    assert answer.headers["content-type"] == "application/problem+json"
    assert (answer.status_code, answer.json()["code"]) == (status, code), answer.text
    assert "Traceback" not in answer.text


@pytest.mark.parametrize("case", BAD_BODIES)
def test_bad_request_is_told_what_is_wrong(served, user, case) -> None:
    body, status, code = BAD_BODIES[case]
    assert_problem(forecast(served, user, json=body), status, code)
    assert forecast(served, user, json={"frames": GOOD}).status_code == 200


@pytest.mark.parametrize(("value", "code"), [(math.nan, "nan_in_json"), (math.inf, "nan_in_json")])
def test_nan_and_infinity_are_no_json(served, user, value, code) -> None:
    body = raw_json(swap(GOOD, 3, 4, [0.0, value, 0.0]))
    assert_problem(forecast(served, user, content=body, headers=JSON_TYPE), 422, code)


def test_infinity_in_msgpack_is_refused_and_nan_is_a_missing_joint(served, user) -> None:
    for value, status in ((math.inf, 422), (math.nan, 200)):
        frames = PERSON[:15].astype("<f4")
        frames[3, 4, 0] = value
        array = {"shape": list(frames.shape), "dtype": "<f4", "data": frames.tobytes()}
        body = msgspec.msgpack.encode({"frames": array})
        answer = forecast(served, user, content=body, headers=MSGPACK_TYPE)
        assert answer.status_code == status


@pytest.mark.parametrize("half", [msgspec.msgpack.encode({"frames": GOOD})[:-100], b"\x81\xa6fra"])
def test_half_a_msgpack_body_cannot_be_read(served, user, half) -> None:
    answer = forecast(served, user, content=half, headers=MSGPACK_TYPE)
    assert_problem(answer, 400, "bad_message")


def test_a_body_of_50_mb_is_refused_and_never_held(served, user) -> None:
    begin = time.monotonic()
    answer = forecast(served, user, content=b" " * 50_000_000, headers=JSON_TYPE)
    assert_problem(answer, 413, "too_large")
    assert time.monotonic() - begin < 10
    assert forecast(served, user, json={"frames": GOOD}).status_code == 200


@pytest.mark.parametrize("size", [3_000_000, 50_000_000])
def test_a_client_that_reads_only_after_it_has_sent_is_told_as_well(served, user, size) -> None:
    """Python's own client sends the whole body first and would see a reset connection."""
    host = served.url.rpartition("/")[2]
    client = http.client.HTTPConnection(host, timeout=30)
    headers = JSON_TYPE | {"Authorization": f"Bearer {served.key}"}
    client.request("POST", f"/v1/users/{user}/forecast", body=b" " * size, headers=headers)
    answer = client.getresponse()
    assert answer.status == 413
    assert json.loads(answer.read())["code"] == "too_large"
    client.close()


def test_keys_and_users_that_do_not_fit_are_refused(served, user) -> None:
    other = add_user(served, "bob")
    bound = add_key(served, "predict", user=other)
    body = {"json": {"frames": GOOD}}
    assert_problem(forecast(served, "nobody", **body), 404, "unknown_user")
    assert_problem(forecast(served, user, NOBODYS_KEY, **body), 401, "unauthorized")
    assert_problem(forecast(served, user, bound, **body), 403, "forbidden")
    assert_problem(forecast(served, "nobody", bound, **body), 403, "forbidden")
    missing = httpx.post(f"{served.url}/v1/users/{user}/forecast", **body, timeout=20)
    assert_problem(missing, 401, "unauthorized")
    assert forecast(served, other, bound, **body).status_code == 200


class Watcher:
    """A stream whose frames are counted for us."""

    def __init__(self, stream: Stream) -> None:
        self.stream = stream
        self.seq, self.t = -1, 0.0

    async def show(self, poses: np.ndarray) -> None:
        """Send frames at once, as if the rest of them lay ahead."""
        self.t = max(self.t, time.monotonic())
        for pose in poses:
            self.seq, self.t = self.seq + 1, self.t + 1 / 30
            await self.stream.send_frame(self.seq, self.t, pose)

    async def expect(self, kind: type[Message]) -> Message:
        for _ in range(2000):
            message = await self.stream.receive()
            if isinstance(message, kind):
                return message
        raise AssertionError(f"no {kind.__name__} came")

    async def assert_lives(self) -> None:
        """The next half second of good frames gets a forecast."""
        await self.show(PERSON[:15])
        forecast = await self.expect(Forecast)
        while forecast.seq < self.seq:
            forecast = await self.expect(Forecast)
        assert np.isfinite(forecast.frames).all()


@asynccontextmanager
async def watch(served, user, subprotocol=MSGPACK, **options):
    async with open_stream(
        served.url, user, key=options.pop("key", served.key), subprotocol=subprotocol, **options
    ) as stream:
        yield Watcher(stream)


def frame_as(subprotocol: str, **fields: object) -> str | bytes:
    """A frame with anything in it."""
    message = {"type": "frame", "seq": 1000, "t": 1000.0} | fields
    if subprotocol == MSGPACK:
        return msgspec.msgpack.encode(message)
    return json.dumps(message)


POSE = PERSON[0].tolist()
PACKED = PERSON[0].astype("<f4").tobytes()
INFINITE = np.full((20, 3), np.inf, "<f4").tobytes()

BAD_FRAMES = {
    "19 joints, JSON": (JSON, {"joints": POSE[:19]}, "wrong_joint_count"),
    "19 joints, msgpack": (MSGPACK, {"joints": PACKED[: 12 * 19]}, "wrong_joint_count"),
    "NaN, JSON": (JSON, {"joints": [[math.nan, 0, 0], *POSE[1:]]}, "nan_in_json"),
    "infinity, JSON": (JSON, {"joints": [[math.inf, 0, 0], *POSE[1:]]}, "nan_in_json"),
    "infinity, msgpack": (MSGPACK, {"joints": INFINITE}, "bad_frame"),
    "strings, JSON": (JSON, {"joints": [["a", "b", "c"], *POSE[1:]]}, "bad_frame"),
    "strings, msgpack": (MSGPACK, {"joints": "a pose"}, "bad_frame"),
    "ragged, JSON": (JSON, {"joints": [[0.0, 1.0], *POSE[1:]]}, "bad_frame"),
    "ragged, msgpack": (MSGPACK, {"joints": PACKED[:-3]}, "bad_frame"),
    "lists in msgpack": (MSGPACK, {"joints": POSE}, "bad_frame"),
    "seq going back": (JSON, {"joints": POSE, "seq": 10}, "seq_not_increasing"),
    "t going back": (JSON, {"joints": POSE, "t": -0.1}, "t_not_increasing"),
    "t the same": (MSGPACK, {"joints": PACKED, "t": 0.0}, "t_not_increasing"),
    "t as text": (JSON, {"joints": POSE, "t": "noon"}, "bad_frame"),
    "an unknown field": (MSGPACK, {"joints": PACKED, "joint": 1}, "unknown_field"),
}


@pytest.mark.asyncio
@pytest.mark.parametrize("case", BAD_FRAMES)
async def test_bad_frame_is_told_and_the_stream_goes_on(served, user, case) -> None:
    subprotocol, fields, code = BAD_FRAMES[case]
    async with watch(served, user, subprotocol) as watcher:
        await watcher.show(PERSON[:15])
        t = fields.get("t", 1000.0)
        after = t if isinstance(t, str) else watcher.t + t
        await watcher.stream.send_raw(frame_as(subprotocol, **(fields | {"t": after})))
        error = await watcher.expect(Error)
        assert (error.code, error.seq) == (code, fields.get("seq", 1000))
        await watcher.assert_lives()


@pytest.mark.asyncio
async def test_fewer_than_15_frames_wait_and_are_told_how_long(served, user) -> None:
    async with watch(served, user) as watcher:
        await watcher.show(PERSON[:14])
        await watcher.stream.ping()
        said = [await watcher.stream.receive() for _ in range(2)]
    waiting = next(message for message in said if not isinstance(message, Pong))
    assert (waiting.reason, waiting.seq) == ("warm_up", 0)
    assert waiting.have_s < waiting.need_s == 0.45


@pytest.mark.asyncio
@pytest.mark.parametrize(
    ("subprotocol", "broken", "code"),
    [
        (MSGPACK, b"\x84\xa4type\xa5frame\xa3seq", 4400),
        (JSON, '{"type": "frame", "seq"', 4400),
        (JSON, "[1, 2]", 4400),
        (JSON, b"\x80", 4400),
        (MSGPACK, b"\xc6\x00\x4c\x4b\x40" + b"\0" * 5_000_000, 4413),
        (JSON, '"' + " " * 5_000_000 + '"', 4413),
    ],
    ids=["half msgpack", "half JSON", "no object", "wrong kind", "5 MB msgpack", "5 MB JSON"],
)
async def test_what_cannot_be_read_ends_the_stream_with_a_reason(
    served, user, subprotocol, broken, code
) -> None:
    async with watch(served, user, subprotocol) as watcher:
        await watcher.stream.send_raw(broken)
        with pytest.raises(ClosedError) as closed:
            await watcher.expect(Other)
    assert closed.value.close_code == code
    assert closed.value.code == {4400: "bad_message", 4413: "too_large"}[code]


@pytest.mark.asyncio
async def test_a_thousand_frames_at_once_end_or_are_all_accounted_for(served, user) -> None:
    async with watch(served, user) as watcher, watch(served, user) as neighbour:
        with suppress(ClosedError):
            await watcher.show(np.resize(PERSON, (1000, 20, 3)))
        with pytest.raises(ClosedError) as closed:
            await watcher.expect(Other)
        assert (closed.value.close_code, closed.value.code) == (4429, "too_fast")
        await neighbour.assert_lives()


@pytest.mark.asyncio
async def test_streams_of_wrong_keys_and_users_say_why(served, user) -> None:
    other = add_user(served, "eve")
    bound = add_key(served, "predict", user=other)
    recorder = add_key(served, "record")
    refusals = [
        ("nobody", served.key, 4404, "unknown_user"),
        (user, NOBODYS_KEY, 4401, "unauthorized"),
        (user, bound, 4403, "forbidden"),
        ("nobody", bound, 4403, "forbidden"),
        (user, recorder, 4403, "forbidden"),
    ]
    for name, key, close_code, code in refusals:
        with pytest.raises(ClosedError) as closed:
            async with watch(served, name, key=key):
                pass
        assert (closed.value.close_code, closed.value.code) == (close_code, code)
    async with watch(served, other, key=bound) as watcher:
        await watcher.assert_lives()


@pytest.mark.asyncio
async def test_a_missing_key_ends_the_stream_after_a_while(served, user) -> None:
    with pytest.raises(ClosedError) as closed:
        async with open_stream(served.url, user, key=None, wait_s=10.0):
            pass
    assert (closed.value.close_code, closed.value.code) == (4401, "unauthorized")


async def _read_all(client: websockets.ClientConnection) -> None:
    while True:
        await client.recv()


async def _flood(client: websockets.ClientConnection, kind: str) -> None:
    for _ in range(2000):
        await getattr(client, kind)()
    await asyncio.wait_for(client.wait_closed(), 10)
    await client.ping()


@pytest.mark.asyncio
@pytest.mark.parametrize("kind", ["ping", "pong"])
async def test_a_flood_of_pings_is_cut_off_and_a_few_are_answered(served, user, kind) -> None:
    async with websockets.connect(
        find_stream_url(served.url, user),
        subprotocols=[websockets.Subprotocol(JSON)],
        additional_headers={"Authorization": f"Bearer {served.key}"},
        proxy=None,
    ) as client:
        await asyncio.wait_for(await client.ping(), 5)
        with pytest.raises(websockets.ConnectionClosed) as caught:
            await _flood(client, kind)
    assert caught.value.rcvd is not None
    assert caught.value.rcvd.code == 4429


@pytest.mark.asyncio
async def test_thousands_of_messages_in_one_read_are_too_many(served, user) -> None:
    async with websockets.connect(
        find_stream_url(served.url, user),
        subprotocols=[websockets.Subprotocol(JSON)],
        additional_headers={"Authorization": f"Bearer {served.key}"},
        proxy=None,
    ) as client:
        await client.recv()
        client.transport.write(Frame(Opcode.PONG, b"").serialize(mask=True) * 5000)
        with pytest.raises(websockets.ConnectionClosed) as caught:
            await asyncio.wait_for(_read_all(client), 10)
    assert caught.value.rcvd is not None
    assert caught.value.rcvd.code == 4429


@pytest.mark.asyncio
async def test_a_message_of_parts_without_end_is_cut_off_and_others_go_on(served, user) -> None:
    part = Frame(Opcode.CONT, b"", fin=False).serialize(mask=True)
    async with websockets.connect(
        find_stream_url(served.url, user),
        subprotocols=[websockets.Subprotocol(JSON)],
        proxy=None,
    ) as client:  # without a key
        begin = Frame(Opcode.BINARY, b"", fin=False).serialize(mask=True)
        client.transport.write(begin + part * 50_000)
        async with httpx.AsyncClient(base_url=served.url, trust_env=False) as other:
            assert (await other.get("/healthz", timeout=5)).status_code == 200
        with pytest.raises(websockets.ConnectionClosed) as caught:
            await asyncio.wait_for(_read_all(client), 10)
    assert caught.value.rcvd is not None
    assert caught.value.rcvd.code == 4429


@pytest.mark.asyncio
async def test_a_client_that_never_reads_is_given_up_and_disturbs_nobody(served, user) -> None:
    small = socket.socket()
    small.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    small.connect(("127.0.0.1", int(served.url.rpartition(":")[2])))
    small.setblocking(False)
    async with websockets.connect(
        find_stream_url(served.url, user),
        sock=small,
        subprotocols=[websockets.Subprotocol(JSON)],
        additional_headers={"Authorization": f"Bearer {served.key}"},
        compression=None,
        ping_interval=None,
        max_queue=1,
        close_timeout=1,
        proxy=None,
    ) as deaf:
        cut_off = asyncio.create_task(_talk(deaf))
        async with watch(served, user) as neighbour:
            for _ in range(30):
                await neighbour.assert_lives()
                await asyncio.wait({cut_off}, timeout=2.0)
                if cut_off.done():
                    break
        assert cut_off.done(), "the service kept a client that reads nothing"
        cut_off.result()


async def _talk(deaf: websockets.ClientConnection) -> None:
    """Send frames at 100 Hz and read nothing, until the service cuts the connection."""
    with suppress(websockets.ConnectionClosed):
        for seq in range(100 * 60):
            joints = PERSON[seq % 60].round(6).tolist()
            await deaf.send(frame_as(JSON, seq=seq, t=time.monotonic(), joints=joints))
            await asyncio.sleep(0.01)
