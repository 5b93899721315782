"""What waits to be sent to one client: every message, but only the newest forecast."""

import asyncio
from collections import deque

from app.domain.errors import KinecastError
from app.live.actions import Ticket
from app.live.protocol import ServerMessage
from app.live.work import EngineResult

FULL = 256
"""Messages at which the stream reads no further until some are sent."""


class Outbox:
    """A queue that a client who never reads cannot make grow.

    A newer forecast takes the place of an older one that was not sent. Other messages are never
    lost, but once `FULL` of them wait, `wait_for_room` holds up those who make them.
    """

    def __init__(self) -> None:
        self.ending: KinecastError | None = None
        self._messages: deque[ServerMessage] = deque()
        self._forecast: tuple[Ticket, EngineResult] | None = None
        self._something = asyncio.Event()
        self._room = asyncio.Event()
        self._room.set()

    def __len__(self) -> int:
        return len(self._messages)

    def __bool__(self) -> bool:
        return bool(self._messages) or self._forecast is not None or self.ending is not None

    def put(self, message: ServerMessage) -> None:
        """Queue a message that must arrive."""
        self._messages.append(message)
        self._something.set()
        if len(self._messages) >= FULL:
            self._room.clear()

    def put_forecast(self, ticket: Ticket, result: EngineResult) -> None:
        """Queue a forecast; it may be replaced by a newer one."""
        self._forecast = (ticket, result)
        self._something.set()

    def end(self, error: KinecastError) -> None:
        """Have the stream closed once the messages are sent; the first reason counts."""
        if self.ending is None:
            self.ending = error
        self._something.set()
        self._room.set()

    @property
    def has_room(self) -> bool:
        """Whether the client takes what is sent."""
        return self._room.is_set()

    async def wait_for_room(self) -> None:
        """Wait until the client has taken some of what waits."""
        await self._room.wait()

    async def wait_for_something(self) -> None:
        """Wait until there is something to send, or the stream is to end."""
        await self._something.wait()
        self._something.clear()

    def take_message(self) -> ServerMessage | None:
        """Take the oldest message, None if there is none."""
        if len(self._messages) <= FULL // 2:
            self._room.set()
        return self._messages.popleft() if self._messages else None

    def take_forecast(self) -> tuple[Ticket, EngineResult] | None:
        """Take the forecast, None if there is none."""
        forecast, self._forecast = self._forecast, None
        return forecast
