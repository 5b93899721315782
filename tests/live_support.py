"""A real server on a free port, and a client of its streams that speaks both subprotocols."""

import asyncio
import json
import socket
import threading
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass
from typing import Any

import httpx
import msgspec
import numpy as np
import websockets
from fastapi import FastAPI
from websockets.asyncio.client import ClientConnection, connect

from app.live.decoders import Decoders
from app.live.protocol import JSON, MSGPACK
from app.main import create_app
from app.server import DrainingServer, make_server
from app.settings import Settings
from app.storage.bootstrap import ensure_admin
from tests.support import ADMIN_KEY, make_decoders, open_database

BOTH = (JSON, MSGPACK)


@dataclass(frozen=True)
class RealServer:
    """A server in a thread of its own."""

    app: FastAPI
    server: DrainingServer
    port: int

    @property
    def http(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def call(self, method: str, path: str, key: str = ADMIN_KEY, **body: Any) -> httpx.Response:
        headers = {"Authorization": f"Bearer {key}"}
        return httpx.request(method, self.http + path, headers=headers, timeout=10, **body)

    def add_user(self, user: str = "ada", **fields: Any) -> None:
        answer = self.call("POST", "/v1/users", json={"id": user, **fields})
        assert answer.status_code == 201, answer.text

    def add_key(self, *scopes: str, user: str | None = None) -> dict[str, Any]:
        answer = self.call("POST", "/v1/admin/keys", json={"scopes": list(scopes), "user": user})
        assert answer.status_code == 201, answer.text
        return answer.json()

    def metric(self, name: str) -> float:
        text = httpx.get(self.http + "/metrics", timeout=10).text
        return sum(
            float(line.rpartition(" ")[2]) for line in text.splitlines() if line.startswith(name)
        )

    @asynccontextmanager
    async def stream(
        self,
        user: str = "ada",
        *,
        subprotocol: str | None = JSON,
        key: str | None = ADMIN_KEY,
        hello: bool = True,
        query: str = "",
        **options: Any,
    ) -> "AsyncIterator[StreamClient]":
        headers = {} if key is None else {"Authorization": f"Bearer {key}"}
        url = f"ws://127.0.0.1:{self.port}/v1/users/{user}/stream{query}"
        names = None if subprotocol is None else [websockets.Subprotocol(subprotocol)]
        async with connect(
            url,
            subprotocols=names,
            additional_headers=headers,
            compression=None,
            max_size=2**22,
            proxy=None,
            **options,
        ) as socket_:
            client = StreamClient(socket_, binary=subprotocol == MSGPACK)
            if hello:
                client.hello = await client.expect("hello")
            yield client


class StreamClient:
    """One end of a stream."""

    def __init__(self, socket_: ClientConnection, *, binary: bool) -> None:
        self.socket = socket_
        self.binary = binary
        self.hello: dict[str, Any] = {}

    async def send(self, **message: Any) -> None:
        if self.binary:
            await self.socket.send(msgspec.msgpack.encode(message))
        else:
            await self.socket.send(json.dumps(message))

    async def frame(self, seq: int, t: float, pose: np.ndarray | None, **fields: Any) -> None:
        joints: Any = None
        if pose is not None and self.binary:
            joints = pose.astype("<f4").tobytes()
        elif pose is not None:
            joints = [None if np.isnan(joint).any() else joint.tolist() for joint in pose]
        await self.send(type="frame", seq=seq, t=t, joints=joints, **fields)

    async def receive(self, within_s: float = 5.0) -> dict[str, Any]:
        async with asyncio.timeout(within_s):
            data = await self.socket.recv()
        assert isinstance(data, bytes) == self.binary
        message = msgspec.msgpack.decode(data) if self.binary else json.loads(data)
        if self.binary and message["type"] == "forecast":
            for name, kind in (("frames", "<f4"), ("t_out", "<f8"), ("radius", "<f4")):
                if message[name] is not None:
                    message[name] = np.frombuffer(message[name], kind)
        return message

    async def expect(self, *types: str, within_s: float = 5.0) -> dict[str, Any]:
        """The next message of one of these types; others are passed over."""
        async with asyncio.timeout(within_s):
            while True:
                message = await self.receive(within_s)
                if message["type"] in types:
                    return message

    async def expect_close(self, within_s: float = 5.0) -> tuple[int, list[dict[str, Any]]]:
        """Read until the server closes; gives the close code and what came before."""
        messages = []
        try:
            async with asyncio.timeout(within_s):
                while True:
                    messages.append(await self.receive(within_s))
        except websockets.ConnectionClosed as closed:
            frame = closed.rcvd
        assert frame is not None, "the server hung up without a close code"
        return frame.code, messages


@contextmanager
def serve(settings: Settings, decoders: Decoders | None = None) -> Iterator[RealServer]:
    """Run a server on a free port until the block ends."""
    app = create_app(settings, decoders=decoders or make_decoders())
    ready = threading.Event()
    server = make_server(app, settings, on_ready=ready.set)
    listener = socket.create_server(("127.0.0.1", 0))

    def live() -> None:
        asyncio.run(_prepare(settings))
        server.run(sockets=[listener])

    thread = threading.Thread(target=live, daemon=True)
    thread.start()
    try:
        assert ready.wait(30), "the server did not start"
        yield RealServer(app, server, listener.getsockname()[1])
    finally:
        server.should_exit = True
        thread.join(20)
        listener.close()
        assert not thread.is_alive(), "the server did not stop"


async def _prepare(settings: Settings) -> None:
    async with open_database(settings) as database:
        await ensure_admin(database, settings)
