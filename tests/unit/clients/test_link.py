"""What the link does on the network, against services that are none."""

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from kinecast_client import Client, UnreachableError
from kinecast_client.link import Link

from app.commands.client.errors import UnreachableError as NotThereError
from app.commands.client.stream import open_stream


@contextmanager
def answer_with(text: str) -> Iterator[tuple[str, list[bytes]]]:
    """A server that answers everything in the same way; gives its address and what was asked."""
    asked: list[bytes] = []
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def work() -> None:
            while True:
                try:
                    peer, _ = listener.accept()
                except OSError:
                    return
                with peer:
                    asked.append(peer.recv(65536))
                    peer.sendall(text.encode())

        thread = threading.Thread(target=work, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{listener.getsockname()[1]}", asked
        listener.shutdown(socket.SHUT_RDWR)
    thread.join(5)


REFUSAL = "HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"


def redirect_to(url: str) -> str:
    place = url.replace("http", "ws")
    return f"HTTP/1.1 307 No\r\nLocation: {place}/x\r\nContent-Length: 0\r\n\r\n"


def test_nobody_else_is_asked_where_a_service_redirects() -> None:
    with (
        answer_with(REFUSAL) as (other, asked),
        answer_with(redirect_to(other)) as (url, first),
        Client(url, "kc_secret") as client,
    ):
        stream = client.stream("ada")
        with pytest.raises(UnreachableError, match="307"):
            stream.open(0.3)
        assert b"kc_secret" in first[0]
        assert asked == []


@pytest.mark.asyncio
async def test_the_command_line_follows_no_redirect_either() -> None:
    with (
        answer_with(REFUSAL) as (other, asked),
        answer_with(redirect_to(other)) as (url, first),
    ):
        with pytest.raises(NotThereError, match="307"):
            async with open_stream(url, "ada", key="kc_secret", wait_s=2.0):
                pass
        assert b"kc_secret" in first[0]
        assert asked == []


def test_a_stream_that_is_closed_while_it_begins_is_closed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    go, has_ended = threading.Event(), threading.Event()
    run, end = Link.run, Link.end

    async def begin_late(link: Link) -> None:
        go.wait()  # the loop is busy with something else
        await run(link)

    def end_and_let_it_begin(link: Link) -> None:
        end(link)
        go.set()
        has_ended.wait(0.2)

    monkeypatch.setattr(Link, "run", begin_late)
    monkeypatch.setattr(Link, "end", end_and_let_it_begin)
    with answer_with("") as (url, asked), Client(url, "kc_secret") as client:
        stream = client.stream("ada")
        began = time.monotonic()
        stream.close()
        assert time.monotonic() - began < 1.5
        assert stream.state == "closed"
        assert stream._running.done()
        assert asked == []
