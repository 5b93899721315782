"""Streams of a real server over a real socket."""

from collections.abc import Iterator
from contextlib import AsyncExitStack

import numpy as np
import pytest

from models.baselines import DECAY
from tests.live_support import BOTH, RealServer, StreamClient, serve
from tests.support import ADMIN_KEY, BASE_SHA256, make_settings, watch_person

PERSON = watch_person(3.0)


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RealServer]:
    with serve(make_settings(tmp_path_factory.mktemp("live"))) as running:
        yield running


@pytest.fixture
def user(server: RealServer, request: pytest.FixtureRequest) -> str:
    user = f"u{abs(hash(request.node.name)) % 10**12}"
    server.add_user(user)
    return user


async def show(client: StreamClient, frames: np.ndarray, *, seq: int = 0) -> None:
    for i, pose in enumerate(frames):
        await client.frame(seq + i, (seq + i) / 30, pose)


@pytest.mark.asyncio
@pytest.mark.parametrize("subprotocol", BOTH)
async def test_a_half_second_of_frames_gives_a_forecast(server, user, subprotocol) -> None:
    async with server.stream(user, subprotocol=subprotocol) as client:
        assert client.hello["joints"][0] == "head"
        assert client.hello["version"]["sha256"] == BASE_SHA256
        await show(client, PERSON[:15])
        waiting = await client.receive()
        forecast = await client.receive()
    assert (waiting["type"], waiting["reason"], waiting["seq"]) == ("waiting", "warm_up", 0)
    assert (forecast["type"], forecast["seq"]) == ("forecast", 14)
    frames = np.asarray(forecast["frames"]).reshape(15, 20, 3)
    velocity = PERSON[14] - PERSON[13]
    np.testing.assert_allclose(frames[0], PERSON[14] + DECAY * velocity, atol=1e-5)
    np.testing.assert_allclose(forecast["t_out"], (14 + np.arange(1, 16)) / 30, atol=1e-12)


@pytest.mark.asyncio
async def test_both_subprotocols_and_the_single_request_agree(server, user) -> None:
    answers = []
    for subprotocol in BOTH:
        async with server.stream(user, subprotocol=subprotocol) as client:
            await show(client, PERSON[:20])
            forecast = await client.expect("forecast")
            while forecast["seq"] < 19:
                forecast = await client.expect("forecast")
            answers.append(np.asarray(forecast["frames"]).reshape(15, 20, 3))
    body = {"frames": PERSON[:20].tolist()}
    single = server.call("POST", f"/v1/users/{user}/forecast", json=body).json()
    np.testing.assert_allclose(answers[0], answers[1], atol=2e-6)
    np.testing.assert_allclose(answers[0], single["frames"], atol=1e-5)


@pytest.mark.asyncio
async def test_every_frame_is_answered_or_counted(server, user) -> None:
    async with server.stream(user) as client:
        await show(client, PERSON[:75])
        accounted: dict[str, int] = {"forecast": 0, "skipped": 0, "error": 0}
        while sum(accounted.values()) < 75 - 14:
            message = await client.expect("forecast", "error")
            accounted[message["type"]] += 1
            accounted["skipped"] += message.get("skipped", 0)
            assert message.get("code", "stale_frame") == "stale_frame"  # on a slow machine
    assert accounted["forecast"] > 0


@pytest.mark.asyncio
async def test_forecast_every_and_coverage_hold_from_the_frame_that_is_named(server, user) -> None:
    async with server.stream(user, query="?forecast_every=5&coverage=0.5") as client:
        assert client.hello["settings"]["forecast_every"] == 5
        await show(client, PERSON[:20])
        assert (await client.expect("forecast"))["coverage"] == 0.5
        await client.send(type="configure", forecast_every=3)
        configured = await client.expect("configured")
        assert configured["settings"]["coverage"] == 0.5
        assert configured["from_seq"] == 20
        await show(client, PERSON[20:27], seq=20)
        seqs = [(await client.expect("forecast"))["seq"]]
        while seqs[-1] != 26:  # the newest that is due is always answered, others may be skipped
            seqs.append((await client.expect("forecast"))["seq"])
    assert seqs == sorted(set(seqs) & {19, 20, 23, 26})


BAD_FRAMES = {
    "strings": ({"joints": [["a", 0, 0]] * 20}, "bad_frame"),
    "ragged": ({"joints": [[0.0, 0.0]] * 20}, "bad_frame"),
    "no list": ({"joints": 7}, "bad_frame"),
    "too few joints": ({"joints": [[0.0, 0.0, 1.0]] * 19}, "wrong_joint_count"),
    "millimetres": ({"joints": [[0.0, 0.0, 1800.0]] * 20}, "bad_frame"),
    "infinite t": ({"joints": None, "t": 1e400}, "nan_in_json"),
    "text as t": ({"joints": None, "t": "now"}, "bad_frame"),
    "unknown field": ({"joints": None, "joint": 1}, "unknown_field"),
    "negative seq": ({"joints": None, "seq": -1}, "bad_frame"),
    "bad confidence": ({"joints": [[0.0, 0.0, 1.0]] * 20, "confidence": [2] * 20}, "bad_frame"),
    "NaN": ({"joints": [[float("nan"), 0.0, 1.0]] * 20}, "nan_in_json"),
}


@pytest.mark.asyncio
@pytest.mark.parametrize("case", BAD_FRAMES)
async def test_a_bad_frame_is_named_and_the_stream_goes_on(server, user, case) -> None:
    fields, code = BAD_FRAMES[case]
    async with server.stream(user) as client:
        await show(client, PERSON[:14])
        await client.send(**({"type": "frame", "seq": 14, "t": 14 / 30} | fields))
        error = await client.expect("error")
        await client.frame(15, 14 / 30, PERSON[14])
        assert (await client.expect("forecast"))["seq"] == 15
    assert error["code"] == code
    if case != "negative seq":
        assert error["seq"] == 14


@pytest.mark.asyncio
@pytest.mark.parametrize("length", [239, 12 * 19, 0])
async def test_wrong_lengths_of_bytes_are_refused(server, user, length) -> None:
    async with server.stream(user, subprotocol=BOTH[1]) as client:
        await client.send(type="frame", seq=0, t=0.0, joints=b"\0" * length)
        error = await client.expect("error")
    assert error["code"] == ("bad_frame" if length % 12 else "wrong_joint_count")


@pytest.mark.asyncio
async def test_seq_and_t_that_go_back_are_refused(server, user) -> None:
    async with server.stream(user) as client:
        await client.frame(5, 1.0, PERSON[0])
        await client.frame(5, 1.1, PERSON[1])
        assert (await client.expect("error"))["code"] == "seq_not_increasing"
        await client.frame(6, 0.5, PERSON[1])
        assert (await client.expect("error"))["code"] == "t_not_increasing"
        await client.frame(7, -5.0, PERSON[1])
        waiting = await client.expect("waiting")
    assert waiting["reason"] in {"warm_up", "clock_restart"}


@pytest.mark.asyncio
@pytest.mark.parametrize("subprotocol", BOTH)
async def test_broken_framing_ends_the_stream(server, user, subprotocol) -> None:
    async with server.stream(user, subprotocol=subprotocol) as client:
        whole = b"\x83\xa4type\xa5frame\xa3seq"
        await client.socket.send(whole if client.binary else '{"type": "fra')
        code, messages = await client.expect_close()
    assert code == 4400
    assert [message["type"] for message in messages] == ["error", "bye"]
    assert messages[0]["code"] == "bad_message"


@pytest.mark.asyncio
async def test_the_other_kind_of_websocket_message_ends_the_stream(server, user) -> None:
    async with server.stream(user) as client:
        await client.socket.send(b"{}")
        assert (await client.expect_close())[0] == 4400


@pytest.mark.asyncio
async def test_a_message_of_5_mb_is_told_that_it_is_too_large(server, user) -> None:
    async with server.stream(user) as client:
        await client.socket.send("[" + " " * 5_000_000 + "]")
        code, messages = await client.expect_close()
    assert (code, messages[0]["code"]) == (4413, "too_large")


@pytest.mark.asyncio
async def test_sixty_mistakes_are_forgiven_and_the_next_is_not(server, user) -> None:
    async with server.stream(user) as client:
        for _ in range(61):
            await client.send(type="frame", seq=0, t=0.0, joints=7)
        code, messages = await client.expect_close()
    codes = [message.get("code") for message in messages]
    assert code == 4400
    assert codes.count("bad_frame") == 61
    assert "too_many_errors" in codes


REFUSALS = {
    "no subprotocol": ({"subprotocol": None}, 4406, "unsupported_subprotocol"),
    "another subprotocol": ({"subprotocol": "other.v9"}, 4406, "unsupported_subprotocol"),
    "wrong key": ({"key": "kc_" + "0" * 32 + "_" + "a" * 43}, 4401, "unauthorized"),
    "unknown user": ({"user": "nobody"}, 4404, "unknown_user"),
    "unknown parameter": ({"query": "?speed=2"}, 4400, "unknown_field"),
    "bad coverage": ({"query": "?coverage=2"}, 4400, "bad_configure"),
    "bad number": ({"query": "?forecast_every=often"}, 4400, "bad_configure"),
    "other joints": ({"query": "?layout=" + "0" * 64}, 4400, "layout_mismatch"),
    "a version that is not there": ({"query": "?version=3"}, 4400, "version_unavailable"),
    "bad session name": ({"query": "?session=a%20b"}, 4400, "bad_configure"),
}


@pytest.mark.asyncio
@pytest.mark.parametrize("case", REFUSALS)
async def test_a_refused_stream_says_why(server, user, case) -> None:
    options, close_code, code = REFUSALS[case]
    async with server.stream(**({"user": user} | options), hello=False) as client:
        closed, messages = await client.expect_close()
    assert (closed, messages[0]["code"]) == (close_code, code)


@pytest.mark.asyncio
async def test_a_key_of_another_user_or_scope_is_refused(server, user) -> None:
    server.add_user(f"{user}-b")
    other = server.add_key("predict", user=f"{user}-b")["key"]
    recorder = server.add_key("record")["key"]
    for key in (other, recorder):
        for name in (user, "nobody"):
            async with server.stream(name, key=key, hello=False) as client:
                assert (await client.expect_close())[0] == 4403
    async with server.stream(f"{user}-b", key=other) as client:
        await client.send(type="trial.start")
        assert (await client.expect("error"))["code"] == "forbidden"


@pytest.mark.asyncio
@pytest.mark.parametrize("subprotocol", BOTH)
async def test_a_browser_sends_its_key_in_the_first_message(server, user, subprotocol) -> None:
    async with server.stream(user, key=None, hello=False, subprotocol=subprotocol) as client:
        await client.send(type="auth", key=ADMIN_KEY)
        assert (await client.receive())["type"] == "hello"
        await client.send(type="trial.start")
        assert (await client.expect("trial"))["state"] == "recording"
    async with server.stream(user, key=None, hello=False, subprotocol=subprotocol) as client:
        await client.send(type="auth", key="a" * 1100)
        assert (await client.expect_close())[0] == 4401
    async with server.stream(user, key=None, hello=False, subprotocol=subprotocol) as client:
        await client.frame(0, 0.0, PERSON[0])
        assert (await client.expect_close())[0] == 4401


@pytest.mark.asyncio
async def test_a_ping_is_answered_with_both_clocks(server, user) -> None:
    async with server.stream(user) as client:
        await client.send(type="ping", id="a", t=12.5)
        pong = await client.expect("pong")
    assert (pong["id"], pong["t"]) == ("a", 12.5)
    assert pong["server_t"] > 0


@pytest.mark.asyncio
async def test_an_unknown_message_or_version_is_told_and_the_stream_goes_on(server, user) -> None:
    async with server.stream(user) as client:
        await client.send(type="dance")
        assert (await client.expect("error"))["code"] == "invalid_request"
        await client.send(type="configure", version=2)
        assert (await client.expect("error"))["code"] == "unknown_version"
        await client.send(type="configure", max_age_ms=-1)
        assert (await client.expect("error"))["code"] == "bad_configure"
        await client.send(type="configure", version=0)
        assert (await client.expect("configured"))["settings"]["version"] == 0
        await show(client, PERSON[:15])
        assert (await client.expect("forecast"))["version"]["requested"] == 0


@pytest.mark.asyncio
async def test_the_newest_stream_of_a_session_fences_the_older(server, user) -> None:
    query = "?session=robot"
    async with server.stream(user, query=query) as old, server.stream(user, query=query) as new:
        code, messages = await old.expect_close(2.0)
        assert new.hello["epoch"] == old.hello["epoch"] + 1
        await show(new, PERSON[:15])
        await new.expect("forecast")
    assert (code, messages[0]["code"]) == (4409, "fenced")


@pytest.mark.asyncio
async def test_only_its_key_or_an_admin_takes_a_session_over(server, user) -> None:
    mine, theirs = server.add_key("predict")["key"], server.add_key("predict")["key"]
    async with server.stream(user, key=mine, query="?session=s") as client:
        async with server.stream(user, key=theirs, query="?session=s", hello=False) as other:
            assert (await other.expect_close())[0] == 4403
        async with server.stream(user, query="?session=s"):
            assert (await client.expect_close(2.0))[0] == 4409


@pytest.mark.asyncio
async def test_deleting_the_user_closes_the_streams(server, user) -> None:
    async with server.stream(user) as client:
        await show(client, PERSON[:15])
        await client.expect("forecast")
        assert server.call("DELETE", f"/v1/users/{user}").status_code == 204
        code, _ = await client.expect_close(2.0)
    assert code == 4410


@pytest.mark.asyncio
async def test_revoking_the_key_closes_its_streams(server, user) -> None:
    made = server.add_key("predict")
    async with server.stream(user, key=made["key"]) as client, server.stream(user) as other:
        assert server.call("DELETE", f"/v1/admin/keys/{made['id']}").status_code == 204
        assert (await client.expect_close(2.0))[0] == 4401
        await other.send(type="ping", id=1, t=0.0)
        await other.expect("pong")


@pytest.mark.asyncio
async def test_a_user_may_have_so_many_streams_and_no_more(server, user) -> None:
    most = 8
    async with AsyncExitStack() as stack:
        for _ in range(most):
            await stack.enter_async_context(server.stream(user))
        async with server.stream(user, hello=False) as client:
            code, messages = await client.expect_close()
        assert (code, messages[0]["code"]) == (4429, "too_fast")
    async with server.stream(user):
        pass
