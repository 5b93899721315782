"""How a service starts, starts again and leaves."""

import subprocess
import sys
import time

import pytest

from app.commands.client.errors import ClosedError, UnreachableError
from app.commands.client.messages import Bye
from app.commands.client.rest import Api
from app.commands.client.stream import open_stream
from app.commands.own_server import run_own_server
from app.settings import make_environment
from tests.flows.conftest import add_user, call

START_S = 10.0


@pytest.mark.asyncio
async def test_sigterm_says_goodbye_to_streams_and_is_not_ready_any_more(tmp_path) -> None:
    with run_own_server(tmp_path) as server:
        user = add_user(server, "ada")
        async with (
            Api(server.url, key=None) as visitor,
            open_stream(server.url, user, key=server.key) as stream,
        ):
            assert await visitor.is_ready()
            server.process.terminate()
            goodbye = await stream.receive()
            ready = await _is_ready(visitor)
            with pytest.raises(ClosedError) as closed:
                await stream.receive()
        assert server.process.wait(20) == 0
    assert isinstance(goodbye, Bye)
    assert goodbye.reason == "draining"
    assert goodbye.retry_after_s > 0
    assert not ready
    assert closed.value.close_code == 1001
    assert not closed.value.is_final
    assert "Traceback" not in server.log.read_text()


async def _is_ready(visitor: Api) -> bool:
    try:
        return await visitor.is_ready()
    except UnreachableError:  # it is gone already
        return False


def test_a_second_start_is_quick_and_remembers(tmp_path) -> None:
    key = "an-admin-key-that-survives-the-restart"
    with run_own_server(tmp_path, key=key) as server:
        add_user(server, "ada")
    begin = time.monotonic()
    with run_own_server(tmp_path, key=key) as server:
        taken = time.monotonic() - begin
        assert call(server, "GET", "/v1/users/ada").status_code == 200
    assert taken < START_S


def test_a_port_in_use_is_one_line_and_status_2(served, tmp_path) -> None:
    port = served.url.rpartition(":")[2]
    done = subprocess.run(
        [sys.executable, "-m", "app.cli", "serve", "--port", port, "--data-dir", str(tmp_path)],
        env=make_environment(),
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1
    assert port in done.stderr
    assert call(served, "GET", "/readyz").status_code == 200
