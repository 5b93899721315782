"""How streams of a real server end, and what they survive."""

import asyncio
import socket
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import torch
import websockets
from torch import Tensor

from app.domain.errors import NotReadyError
from app.live.decoders import Decoders
from app.settings import Settings
from models.baselines import DampedVelocity
from tests.live_support import BOTH, StreamClient, serve
from tests.support import BASE_SHA256, make_settings, watch_person

PERSON = watch_person(3.0)


async def show(
    client: StreamClient, frames: np.ndarray, *, seq: int = 0, since: float = 0.0
) -> None:
    for i, pose in enumerate(frames):
        await client.frame(seq + i, since + i / 30, pose)


@pytest.mark.asyncio
async def test_a_thousand_frames_at_once_are_too_fast(tmp_path: Path) -> None:
    with serve(make_settings(tmp_path, max_rate_hz=15.0)) as server:
        server.add_user()
        async with server.stream(subprotocol=BOTH[1]) as client:
            with suppress(websockets.ConnectionClosed):
                for i in range(1000):
                    await client.frame(i, i / 30, PERSON[i % 60])
            code, messages = await client.expect_close(20.0)
    assert code == 4429
    assert [message["type"] for message in messages[-2:]] == ["error", "bye"]
    assert messages[-2]["code"] == "too_fast"


@pytest.mark.asyncio
async def test_a_stream_without_messages_is_closed(tmp_path: Path) -> None:
    with serve(make_settings(tmp_path, idle_s=0.5)) as server:
        server.add_user()
        async with server.stream() as client:
            code, messages = await client.expect_close(5.0)
    assert code == 4408
    assert messages[-1]["type"] == "bye"
    assert messages[-1]["retry_after_s"] > 0


@pytest.mark.asyncio
async def test_a_server_that_drains_says_goodbye(tmp_path: Path) -> None:
    with serve(make_settings(tmp_path)) as server:
        server.add_user()
        async with server.stream() as client:
            await show(client, PERSON[:20])
            await client.expect("forecast")
            server.server.handle_exit(15, None)
            code, messages = await client.expect_close(5.0)
        assert code == 1001
        goodbye = messages[-1]
        assert (goodbye["type"], goodbye["reason"]) == ("bye", "draining")
        assert goodbye["retry_after_s"] > 0


@pytest.mark.asyncio
async def test_a_client_that_never_reads_is_given_up(tmp_path: Path) -> None:
    with serve(make_settings(tmp_path, max_rate_hz=1000.0)) as server:
        server.add_user()
        small = socket.socket()
        small.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        small.connect(("127.0.0.1", server.port))
        small.setblocking(False)
        async with server.stream(sock=small, max_queue=1, close_timeout=1) as client:
            assert server.metric("kinecast_streams_open ") == 1
            with suppress(websockets.ConnectionClosed, TimeoutError):
                async with asyncio.timeout(40):
                    for i in range(100_000):
                        await client.frame(i, i / 30, PERSON[i % 60])
                        await asyncio.sleep(0.002)
                        if i % 500 == 0 and server.metric("kinecast_streams_open ") == 0:
                            break
            assert server.metric("kinecast_streams_open ") == 0
            assert server.call("GET", "/readyz").status_code == 200


@pytest.mark.asyncio
async def test_a_stream_on_another_replica_fences_the_older_one(settings: Settings) -> None:
    query = "?session=robot"
    with serve(settings) as here, serve(settings) as there:
        here.add_user()
        async with here.stream(query=query) as old:
            await show(old, PERSON[:15])
            await old.expect("forecast")
            async with there.stream(query=query) as new:
                assert new.hello["epoch"] == old.hello["epoch"] + 1
                code, _ = await old.expect_close(2.0)
                await show(new, PERSON[:15])
                await new.expect("forecast")
    assert code == 4409


@pytest.mark.asyncio
async def test_who_shows_no_key_in_time_is_refused(tmp_path: Path) -> None:
    with serve(make_settings(tmp_path)) as server:
        server.add_user()
        begun = time.monotonic()
        async with server.stream(key=None, hello=False) as client:
            code, messages = await client.expect_close(8.0)
        assert 4.9 < time.monotonic() - begun < 7
    assert (code, messages[0]["code"]) == (4401, "unauthorized")


@pytest.mark.asyncio
async def test_a_root_relative_user_is_told_so_on_both_routes(tmp_path: Path) -> None:
    with serve(make_settings(tmp_path)) as server:
        server.add_user(root_relative=True)
        async with server.stream() as client:
            await show(client, PERSON[:15])
            streamed = await client.expect("forecast")
        body = {"frames": PERSON[:15].tolist()}
        single = server.call("POST", "/v1/users/ada/forecast", json=body).json()
    assert "root_relative" in streamed["quality"]
    assert "root_relative" in single["quality"]


class Moody:
    """A net that fails on people who stand too far to the right, and raves about the left ones.

    It sees people relative to their hips, so what tells them apart is how far apart their feet are.
    """

    def __call__(self, window: Tensor) -> Tensor:
        stride = (window[:, -1, 15] - window[:, -1, 19]).norm(dim=-1)
        if (stride > 3).any():
            raise RuntimeError("out of luck")
        forecast = DampedVelocity(15)(window)
        return torch.where((stride > 2)[:, None, None, None], torch.nan, forecast)


@pytest.mark.asyncio
@pytest.mark.parametrize(("stride", "reason"), [(2.5, "guard"), (3.5, "engine_error")])
async def test_a_net_that_fails_is_replaced_and_says_so(tmp_path: Path, stride, reason) -> None:
    odd = PERSON.copy()
    odd[:, 15, 0] = odd[:, 19, 0] + stride
    odd[:, 15, 1:] = odd[:, 19, 1:]
    with serve(make_settings(tmp_path), Decoders(Moody(), base_sha256=BASE_SHA256)) as server:
        server.add_user()
        server.add_user("bob")
        async with server.stream() as client, server.stream("bob") as other:
            await show(client, odd[:15])
            await show(other, PERSON[:15])
            forecast, healthy = await client.expect("forecast"), await other.expect("forecast")
        counted = server.metric("kinecast_fallbacks_total{")
    version = forecast["version"]
    assert (version["kind"], version["fallback"]) == ("damped_velocity", reason)
    assert version["number"] is None
    assert version["sha256"] is None
    assert {"fallback", "uncalibrated"} <= set(forecast["quality"])
    assert forecast["severity"] != "info"
    assert np.isfinite(np.array(forecast["frames"])).all()
    assert healthy["version"]["kind"] == "base"
    assert counted == 1


@pytest.mark.asyncio
async def test_without_a_database_forecasts_are_flagged_and_then_end(tmp_path: Path) -> None:
    settings = make_settings(tmp_path, version_unconfirmed_s=0.5, version_unconfirmed_close_s=2.5)
    with serve(settings) as server:
        server.add_user()
        async with server.stream() as client:
            await show(client, PERSON[:15])
            assert "version_unconfirmed" not in (await client.expect("forecast"))["quality"]
            server.app.state.registry._watch = _no_database
            await asyncio.sleep(1.2)
            await show(client, PERSON[:15], seq=15, since=2.0)
            flagged = await client.expect("forecast")
            code, messages = await client.expect_close(5.0)
    assert "version_unconfirmed" in flagged["quality"]
    assert flagged["severity"] == "degraded"
    assert (code, messages[-2]["code"]) == (1011, "not_ready")


async def _no_database(streams: object) -> dict[object, object]:
    raise NotReadyError
