"""The HTTP and WebSocket server, which says goodbye before it hangs up."""

import asyncio
import socket
from collections.abc import Callable
from types import FrameType

import structlog
import uvicorn
from fastapi import FastAPI

from app.api.sockets import StreamProtocol
from app.main import drain
from app.settings import Settings

log = structlog.get_logger(__name__)


class DrainingServer(uvicorn.Server):
    """Uvicorn, but a signal first lets the streams end properly.

    Left alone, uvicorn closes every socket at once. Here the replica first counts as not ready,
    its streams are told to go elsewhere, and only then does the server stop. A second signal stops
    it at once.
    """

    def __init__(
        self, config: uvicorn.Config, application: FastAPI, *, on_ready: Callable[[], None]
    ) -> None:
        super().__init__(config)
        self._application = application
        self._on_ready = on_ready
        self._loop: asyncio.AbstractEventLoop | None = None
        self._drain: asyncio.Task[None] | None = None
        self._told = False

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start, and say so once requests are answered."""
        self._loop = asyncio.get_running_loop()
        await super().startup(sockets)
        if self.started and not self.should_exit:
            self._on_ready()

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Begin to leave at the first signal, leave at the second."""
        del sig, frame
        if self._told or self._loop is None or not self.started:
            self.force_exit = self._told
            self.should_exit = True
            return
        self._told = True
        self._loop.call_soon_threadsafe(self._begin_to_drain)

    def _begin_to_drain(self) -> None:
        self._drain = asyncio.ensure_future(self._drain_and_exit())

    async def _drain_and_exit(self) -> None:
        try:
            await drain(self._application)
        finally:
            self.should_exit = True


def make_server(
    application: FastAPI, settings: Settings, *, on_ready: Callable[[], None] = lambda: None
) -> DrainingServer:
    """Make the server of an application."""
    config = uvicorn.Config(
        application,
        host=settings.host,
        port=settings.port,
        log_config=None,
        access_log=False,
        server_header=False,
        date_header=True,
        proxy_headers=False,
        ws=StreamProtocol,
        ws_max_size=settings.max_message_bytes,
        ws_max_queue=8,
        ws_per_message_deflate=False,
        ws_ping_interval=None,
        timeout_graceful_shutdown=max(1, round(settings.drain_s)),
        backlog=2048,
    )
    return DrainingServer(config, application, on_ready=on_ready)
