"""The Python client against servers whose answers never end, or never begin."""

import gc
import socket
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress

import pytest
from kinecast_client import AnswerError, AsyncClient, Client, DeadlineError


@contextmanager
def answering(parts: Iterable[bytes]) -> Iterator[str]:
    """A server that answers one request by these parts."""
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def answer() -> None:
            connection, _ = listener.accept()
            with connection, suppress(OSError):
                connection.recv(65_536)
                for part in parts:
                    connection.sendall(part)

        thread = threading.Thread(target=answer)
        thread.start()
        yield f"http://127.0.0.1:{listener.getsockname()[1]}"
        thread.join()


def trickle() -> AbstractContextManager[str]:
    """A server that sends a byte of its answer now and then."""

    def parts() -> Iterator[bytes]:
        yield b"HTTP/1.1 200 OK\r\nContent-Length: 1000\r\n\r\n"
        for _ in range(100):
            yield b" "
            time.sleep(0.05)

    return answering(parts())


def dawdle() -> AbstractContextManager[str]:
    """A server that goes on greeting, so that the answer itself never begins."""

    def parts() -> Iterator[bytes]:
        for _ in range(100):
            yield b"HTTP/1.1 103 Early Hints\r\n\r\n"
            time.sleep(0.05)

    return answering(parts())


def flood() -> AbstractContextManager[str]:
    """A server whose answer is longer than anybody should have to hold."""
    return answering([b"HTTP/1.1 200 OK\r\n\r\n", *[bytes(2**20)] * 65])


def test_an_answer_without_end_is_given_up_before_it_fills_the_memory():
    too_long = pytest.raises(AnswerError, match="longer than 64 MiB")
    with flood() as url, Client(url, "key") as client, too_long:
        client.users.get("ada")


@pytest.mark.asyncio
async def test_an_answer_without_end_is_given_up_by_a_task_too():
    with flood() as url:
        async with AsyncClient(url, "key") as client:
            with pytest.raises(AnswerError, match="longer than 64 MiB"):
                await client.users.get("ada")


@pytest.mark.parametrize("serve_slowly", [trickle, dawdle])
def test_an_answer_that_trickles_in_is_given_up_at_the_deadline(serve_slowly):
    with serve_slowly() as url, Client(url, "key", timeout_s=0.3) as client:
        begin = time.monotonic()
        with pytest.raises(DeadlineError):
            client.users.get("ada")
        assert time.monotonic() - begin < 2.0


@pytest.mark.asyncio
async def test_an_answer_that_trickles_in_is_given_up_at_the_deadline_of_a_task_too():
    with trickle() as url:
        async with AsyncClient(url, "key", timeout_s=0.3) as client:
            begin = time.monotonic()
            with pytest.raises(DeadlineError):
                await client.users.get("ada")
            assert time.monotonic() - begin < 2.0


def count_loops() -> int:
    return sum(thread.name == "kinecast-client" for thread in threading.enumerate())


def test_a_client_that_nobody_closes_leaves_no_thread():
    before = count_loops()
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    client = Client(f"http://127.0.0.1:{port}", "key")
    assert not client.is_ready()
    assert count_loops() == before + 1
    del client
    gc.collect()
    deadline = time.monotonic() + 5
    while count_loops() > before:
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_a_closed_client_says_so():
    client = Client("http://127.0.0.1:9", "key")
    client.close()
    for ask in (lambda: client.users.get("ada"), lambda: client.stream("ada")):
        with pytest.raises(RuntimeError, match="closed"):
            ask()
