"""The WebSocket of the load generator: frames in bytes, and whole connections."""

import asyncio
import struct

import pytest
from websockets.asyncio.server import ServerConnection, serve
from websockets.frames import Frame, Opcode

from app.commands.bench.inbox import MAX_MESSAGE_BYTES, ROOM, FramingError, Inbox, Kind
from app.commands.bench.link import open_link
from app.commands.client.errors import UnreachableError
from app.commands.client.messages import JSON, MSGPACK

TEXT, BINARY, MORE = Opcode.TEXT, Opcode.BINARY, Opcode.CONT


def write(opcode: Opcode, data: bytes, *, fin: bool = True) -> bytes:
    return Frame(opcode, data, fin=fin).serialize(mask=False)


def read(*pieces: bytes) -> list[tuple[int, bytes]]:
    """Feed pieces of a stream of bytes to an inbox, and give every message."""
    inbox, found = Inbox(), []
    for piece in pieces:
        left = memoryview(piece)
        while left:
            room = inbox.room()
            count = min(len(room), len(left))
            room[:count] = left[:count]
            inbox.add(count)
            left = left[count:]
            while (message := inbox.take_message()) is not None:
                found.append((message[0], bytes(message[1])))
    return found


def split(data: bytes, size: int) -> list[bytes]:
    return [data[i : i + size] for i in range(0, len(data), size)]


@pytest.mark.parametrize("size", [0, 1, 125, 126, 5000, 65_535, 65_536, 300_000])
def test_messages_of_every_length_are_read_however_they_arrive(size: int) -> None:
    message = bytes(i % 251 for i in range(size))
    stream = write(BINARY, message) + write(TEXT, b"after")
    for pieces in ([stream], split(stream, 1 + size // 3), split(stream, 7 + size // 50)):
        assert read(*pieces) == [(Kind.BINARY, message), (Kind.TEXT, b"after")]


def test_many_messages_go_through_a_buffer_that_stays_small() -> None:
    messages = [bytes([i % 256]) * (4000 + i) for i in range(100)]
    stream = b"".join(write(BINARY, message) for message in messages)
    assert len(stream) > 5 * ROOM
    assert [data for _, data in read(*split(stream, 3333))] == messages


def test_parts_are_put_together_around_a_ping() -> None:
    pieces = (
        write(TEXT, b"one ", fin=False),
        write(Opcode.PING, b"?"),
        write(MORE, b"two ", fin=False) + write(MORE, b"three") + write(BINARY, b"next"),
    )
    expected = [(Kind.PING, b"?"), (Kind.TEXT, b"one two three"), (Kind.BINARY, b"next")]
    assert read(*pieces) == expected


@pytest.mark.parametrize(
    "wrong",
    [
        write(MORE, b"of nothing"),
        write(TEXT, b"begun", fin=False) + write(TEXT, b"another"),
        b"\x81\x81maska",
        b"\xc1\x01a",
        b"\x83\x01a",
        b"\x09\x01a",
        struct.pack(">BBQ", 0x82, 127, MAX_MESSAGE_BYTES + 1),
    ],
)
def test_what_no_server_may_send_is_refused(wrong: bytes) -> None:
    with pytest.raises(FramingError):
        read(wrong)


def run_against(handler, talk, subprotocol: str = MSGPACK):
    """Run a server for one connection, and a client that talks to it."""

    async def main():
        heard: list[bytes] = []
        async with serve(handler, "127.0.0.1", 0, subprotocols=[subprotocol]) as server:
            port = server.sockets[0].getsockname()[1]
            link = await open_link(
                f"http://127.0.0.1:{port}",
                "ada",
                lambda payload: heard.append(bytes(payload)),
                key="secret",
                subprotocol=subprotocol,
            )
            try:
                return await asyncio.wait_for(talk(link, heard), 10)
            finally:
                await link.close()

    return asyncio.run(main())


async def until(condition) -> None:
    while not condition():  # noqa: ASYNC110 - of bytes on their way
        await asyncio.sleep(0.001)


@pytest.mark.parametrize(("subprotocol", "kind"), [(MSGPACK, bytes), (JSON, str)])
def test_link_speaks_with_a_real_server(subprotocol: str, kind: type) -> None:
    seen: dict[str, object] = {}

    async def handle(socket: ServerConnection) -> None:
        seen["path"], seen["key"] = socket.request.path, socket.request.headers["Authorization"]
        async for message in socket:
            seen["kind"] = type(message)
            await (await socket.ping())
            await socket.send([message, message])  # in two frames

    async def talk(link, heard):
        for size in (1, 300):
            link.send(b"x" * size)
        await until(lambda: len(heard) == 2)
        link.pause()
        link.send(b"y")
        await asyncio.sleep(0.05)
        assert len(heard) == 2
        link.resume()
        await until(lambda: len(heard) == 3)
        return heard

    assert run_against(handle, talk, subprotocol) == [b"xx", b"x" * 600, b"yy"]
    assert seen == {"path": "/v1/users/ada/stream", "key": "Bearer secret", "kind": kind}


def test_link_tells_why_it_was_closed() -> None:
    async def handle(socket: ServerConnection) -> None:
        await socket.close(4409, "fenced")

    async def talk(link, heard):
        ended = await link.ended
        link.send(b"nobody listens")
        return ended

    ended = run_against(handle, talk)
    assert (ended.close_code, "fenced" in str(ended)) == (4409, True)


def test_link_tells_that_it_broke() -> None:
    async def handle(socket: ServerConnection) -> None:
        socket.transport.abort()

    async def talk(link, heard):
        return await link.ended

    assert run_against(handle, talk).close_code == 1006


def test_link_ends_where_bytes_make_no_sense() -> None:
    async def handle(socket: ServerConnection) -> None:
        socket.transport.write(b"\xff\xff\xff\xff")
        await socket.wait_closed()

    async def talk(link, heard):
        return await link.ended

    assert run_against(handle, talk).close_code == 1002


def test_link_needs_a_service_that_wants_it() -> None:
    async def refuse() -> None:
        async with serve(
            lambda socket: None, "127.0.0.1", 0, process_request=lambda s, r: s.respond(403, "no")
        ) as server:
            url = f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}"
            await open_link(url, "ada", lambda _: None, key="k", subprotocol=MSGPACK)

    async def nobody() -> None:
        await open_link("http://127.0.0.1:9", "ada", lambda _: None, key="k", subprotocol=JSON)

    for attempt in (refuse, nobody):
        with pytest.raises(UnreachableError):
            asyncio.run(attempt())
