"""Clients of the servers: requests on a connection that is kept, and frames on a stream."""

import asyncio
import base64
import json
import re
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import NamedTuple
from urllib.parse import urlsplit

import msgspec
import numpy as np

from app.commands.client.messages import Error, Forecast, Waiting
from app.commands.client.stream import Stream, open_stream
from benchmarks.peers.people import SPEC, Person, Poses, from_bytes, to_bytes

CONTENT_LENGTH = re.compile(rb"\r\ncontent-length: *(\d+)\r\n", re.IGNORECASE)
PATIENCE_S = 300.0
"""Longest wait for anything; machines pause."""


class PeerError(RuntimeError):
    """A server does not answer as it should."""


class Request(NamedTuple):
    """One request."""

    path: str
    headers: dict[str, str]
    body: bytes


@dataclass(frozen=True, slots=True)
class Form:
    """How a server wants to be asked.

    Attributes:
        write: a person's request.
        read: the forecast out of the body of the answer.
    """

    write: Callable[[Person], Request]
    read: Callable[[bytes], Poses]


@dataclass(slots=True)
class HttpClient:
    """One person's requests, one after the other; no more of HTTP/1.1 than that needs."""

    person: Person
    form: Form
    host: str
    reader: asyncio.StreamReader
    writer: asyncio.StreamWriter

    async def ask(self) -> Poses:
        """Ask for one forecast.

        Raises:
            PeerError: an answer that is no forecast.
            OSError: the connection broke.
        """
        path, headers, body = self.form.write(self.person)
        told = {"Host": self.host, "Content-Length": str(len(body)), **headers}
        lines = [f"POST {path} HTTP/1.1", *(f"{name}: {value}" for name, value in told.items())]
        self.writer.write("\r\n".join([*lines, "", ""]).encode() + body)
        head = await self.reader.readuntil(b"\r\n\r\n")
        length = CONTENT_LENGTH.search(head)
        content = await self.reader.readexactly(int(length[1])) if length else b""
        if head.split(maxsplit=2)[1] != b"200" or not length:
            raise PeerError(f"{(head + content)[:300].decode(errors='replace')!r}")
        return self.form.read(content)


@asynccontextmanager
async def open_http(url: str, person: Person, form: Form) -> AsyncIterator[HttpClient]:
    """Connect one person to a server."""
    address = urlsplit(url)
    reader, writer = await asyncio.open_connection(address.hostname, address.port)
    try:
        yield HttpClient(person, form, address.netloc, reader, writer)
    finally:
        writer.close()


@dataclass(slots=True)
class StreamClient:
    """One person's stream: a frame, then its forecast, then the next frame.

    The frames' times are those of a sensor at 30 Hz, however fast the answers come.
    """

    person: Person
    stream: Stream
    seq: int = -1

    async def show_window(self) -> Poses:
        """Have the person's window forecast, as the others do in every request."""
        for _ in self.person.window[:-1]:
            await self._send()
        return await self.ask()

    async def ask(self) -> Poses:
        """Send the next frame and wait for its forecast.

        Raises:
            PeerError: an answer that is no forecast by the person's own decoder.
            ClientError: the stream ended, or nothing came.
        """
        await self._send()
        return await self._receive()

    async def _send(self) -> None:
        """Send the next frame; the motion goes backwards where it ends."""
        self.seq += 1
        last = len(self.person.motion) - 1
        pose = self.person.motion[last - abs(last - self.seq % (2 * last))]
        await self.stream.send_frame(self.seq, self.seq / SPEC.rate_hz, pose)

    async def _receive(self) -> Poses:
        """Wait for the answer to the newest frame."""
        while True:
            match await self.stream.receive():
                case Forecast() as made if made.seq == self.seq:
                    if made.version.kind != "personal" or made.version.fallback is not None:
                        raise PeerError(f"answered by {made.version}")
                    return made.frames
                case Waiting() as waiting if waiting.seq == self.seq:
                    raise PeerError(f"no forecast: {waiting.reason}")
                case Error() as error:
                    raise PeerError(f"{error.code}: {error.message}")


@asynccontextmanager
async def open_streaming(url: str, person: Person, *, key: str) -> AsyncIterator[StreamClient]:
    """Open one person's stream."""
    async with open_stream(url, person.user, key=key, wait_s=PATIENCE_S) as stream:
        yield StreamClient(person, stream)


def make_ray_form() -> Form:
    """Say how the server of Ray Serve is asked: bytes, and who it is in a header."""

    def write(person: Person) -> Request:
        headers = {
            "serve_multiplexed_model_id": person.user,
            "Content-Type": "application/octet-stream",
        }
        return Request("/", headers, to_bytes(person.window))

    return Form(write, from_bytes)


def make_litserve_form() -> Form:
    """Say how the server of LitServe is asked: JSON with bytes in base64."""

    def write(person: Person) -> Request:
        window = base64.b64encode(to_bytes(person.window)).decode()
        body = json.dumps({"user": person.user, "window": window}).encode()
        return Request("/predict", {"Content-Type": "application/json"}, body)

    return Form(write, lambda body: from_bytes(base64.b64decode(json.loads(body)["frames"])))


def make_kinecast_form(key: str) -> Form:
    """Say how Kinecast is asked over REST: msgpack, as its client does."""
    kind = "application/msgpack"
    headers = {"Authorization": f"Bearer {key}", "Content-Type": kind, "Accept": kind}

    def write(person: Person) -> Request:
        poses = {"shape": [*person.window.shape], "dtype": "<f4", "data": to_bytes(person.window)}
        body = msgspec.msgpack.encode({"frames": poses})
        return Request(f"/v1/users/{person.user}/forecast", headers, body)

    return Form(write, _read_kinecast)


def _read_kinecast(body: bytes) -> Poses:
    answer = msgspec.msgpack.decode(body)
    if answer["version"]["kind"] != "personal" or answer["version"]["fallback"] is not None:
        raise PeerError(f"answered by {answer['version']}")
    frames = answer["frames"]
    return np.frombuffer(frames["data"], frames["dtype"]).reshape(frames["shape"])
