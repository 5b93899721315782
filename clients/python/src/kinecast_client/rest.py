"""Requests over HTTP, each with a deadline that nothing on the way can stretch."""

import asyncio
from typing import Any, NamedTuple

import httpx

from kinecast_client.address import is_loopback
from kinecast_client.answers import Content
from kinecast_client.calls import Call
from kinecast_client.errors import DeadlineError, UnreachableError


class Response(NamedTuple):
    """What was answered."""

    status: int
    headers: httpx.Headers
    content: bytes


class Rest:
    """Asks a service, on one event loop."""

    def __init__(self, url: str, key: str) -> None:
        self._url = url
        self._http = httpx.AsyncClient(
            base_url=url,
            headers={"Authorization": f"Bearer {key}"},
            trust_env=not is_loopback(url),
        )

    async def request(self, call: Call[Any], timeout_s: float) -> Response:
        """Send a request and give what is answered.

        Raises:
            DeadlineError: the whole of the answer did not come in time.
            UnreachableError: nobody answers.
            AnswerError: the answer is longer than a program should have to hold.
        """
        try:
            return await asyncio.wait_for(self._ask(call), timeout_s)
        except asyncio.TimeoutError:
            raise explain_delay(self._url, timeout_s) from None
        except httpx.RequestError as error:
            raise UnreachableError(f"Nobody answers at {self._url}: {error}.") from error

    async def close(self) -> None:
        """Close the connections."""
        await self._http.aclose()

    async def _ask(self, call: Call[Any]) -> Response:
        content = Content()
        async with self._http.stream(**call.to_httpx(), timeout=None) as response:
            async for part in response.aiter_bytes():
                content.add(part)
        return Response(response.status_code, response.headers, bytes(content))


def explain_delay(url: str, timeout_s: float) -> DeadlineError:
    """Say that no answer came in time."""
    return DeadlineError(f"{url} did not answer within {timeout_s:g} s.")
