"""The client against a server that can misbehave: every wait has an end."""

import asyncio
from contextlib import asynccontextmanager

import msgspec
import pytest
import websockets
from websockets.asyncio.server import serve

from app.commands.client.errors import ClosedError, SilenceError, UnreachableError
from app.commands.client.messages import JSON, Bye, Error, Ping, Pong
from app.commands.client.stream import open_stream

VERSION = {"number": 0, "kind": "base", "sha256": None}
HELLO = {
    "type": "hello",
    "protocol": 1,
    "session": "s",
    "epoch": 1,
    "user": "ada",
    "skeleton": "kinect_v1",
    "joints": ["head"],
    "rate_hz": 30.0,
    "observe": 15,
    "horizon": 15,
    "version": VERSION,
    "settings": {},
    "limits": {},
}


def write(**message: object) -> str:
    return msgspec.json.encode(message).decode()


@asynccontextmanager
async def stream_with(behave, *, wait_s: float = 5.0, clock=None):
    """A stream to a server that does what it is told after its hello."""
    async with serve(behave, "127.0.0.1", 0, subprotocols=[websockets.Subprotocol(JSON)]) as server:
        port = server.sockets[0].getsockname()[1]
        options = {} if clock is None else {"clock": clock}
        async with open_stream(
            f"http://127.0.0.1:{port}", "ada", key="k", subprotocol=JSON, wait_s=wait_s, **options
        ) as stream:
            yield stream


@pytest.mark.asyncio
async def test_pings_are_answered_with_the_clock_of_the_frames() -> None:
    answers = []

    async def behave(socket) -> None:
        await socket.send(write(**HELLO))
        await socket.send(write(type="ping", id=4, server_t=9.0))
        answers.append(msgspec.json.decode(await socket.recv()))

    async with stream_with(behave, clock=lambda: 77.0) as stream:
        assert isinstance(await stream.receive(), Ping)
        await asyncio.sleep(0.05)
    assert answers == [{"type": "pong", "id": 4, "server_t": 9.0, "t": 77.0}]


@pytest.mark.asyncio
async def test_offset_is_taken_from_the_shortest_round_trip() -> None:
    async def behave(socket) -> None:
        await socket.send(write(**HELLO))
        async for data in socket:
            ping = msgspec.json.decode(data)
            answer = {"type": "pong", "id": ping["id"], "t": ping["t"], "engine_ms": 1.0}
            await socket.send(write(**answer, server_t=1000.0 + ping["t"]))

    times = iter([10.0, 10.2, 20.0, 20.02, 30.0, 31.0])
    async with stream_with(behave, clock=lambda: next(times)) as stream:
        offsets = []
        for _ in range(3):
            await stream.ping()
            assert isinstance(await stream.receive(), Pong)
            offsets.append(stream.offset_s)
    assert offsets == pytest.approx([999.9, 999.99, 999.99])


@pytest.mark.asyncio
async def test_silence_is_an_error_and_not_a_wait_for_ever() -> None:
    async def behave(socket) -> None:
        await socket.send(write(**HELLO))
        await socket.wait_closed()

    async with stream_with(behave, wait_s=0.2) as stream:
        with pytest.raises(SilenceError):
            await stream.receive()


@pytest.mark.asyncio
async def test_server_without_a_hello_is_an_error() -> None:
    async def behave(socket) -> None:
        await socket.wait_closed()

    with pytest.raises(SilenceError):
        async with stream_with(behave, wait_s=0.2):
            pass


@pytest.mark.asyncio
async def test_end_names_its_reason_and_not_an_older_error() -> None:
    async def behave(socket) -> None:
        await socket.send(write(**HELLO))
        await socket.send(write(type="error", code="bad_frame", message="Not so."))
        await socket.send(write(type="bye", reason="draining", retry_after_s=0.5))
        await socket.close(1001, "draining")

    async with stream_with(behave) as stream:
        assert isinstance(await stream.receive(), Error)
        assert isinstance(await stream.receive(), Bye)
        with pytest.raises(ClosedError) as closed:
            await stream.receive()
    assert (closed.value.close_code, closed.value.code) == (1001, "draining")
    assert closed.value.retry_after_s == 0.5
    assert not closed.value.is_final


@pytest.mark.asyncio
async def test_refusal_is_raised_with_its_message() -> None:
    async def behave(socket) -> None:
        await socket.send(write(type="error", code="unauthorized", message="No such key."))
        await socket.send(write(type="bye", reason="unauthorized"))
        await socket.close(4401)

    with pytest.raises(ClosedError, match="No such key") as closed:
        async with stream_with(behave):
            pass
    assert closed.value.is_final


@pytest.mark.asyncio
async def test_broken_connection_is_told_apart() -> None:
    async def behave(socket) -> None:
        await socket.send(write(**HELLO))
        socket.transport.abort()

    async with stream_with(behave) as stream:
        with pytest.raises(ClosedError) as closed:
            await stream.receive()
    assert closed.value.close_code == 1006
    assert not closed.value.is_final


@pytest.mark.asyncio
async def test_nobody_there_is_an_error() -> None:
    with pytest.raises(UnreachableError):
        async with open_stream("http://127.0.0.1:9", "ada", key=None, wait_s=1.0):
            pass
