"""The Python client's two shells around one core: threads, tasks, callbacks, deadlines."""

import asyncio
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from kinecast_client import (
    AsyncClient,
    Client,
    Clip,
    ConflictError,
    Connected,
    DeadlineError,
    NotFoundError,
    RecordingError,
    RefusedError,
    Stopped,
    StoppedError,
    UnreachableError,
    UserDeletedError,
    Waiting,
)
from kinecast_client.samples import JOINTS, waving_person

from tests.conftest import ROOT
from tests.live_support import RealServer, serve
from tests.support import ADMIN_KEY, make_settings

JOINTS_BY_NAME: dict[str, int] = {}
POSES = waving_person(seconds=60.0)


@pytest.fixture(scope="module")
def server(tmp_path_factory) -> Iterator[RealServer]:
    with serve(make_settings(tmp_path_factory.mktemp("service"))) as running:
        running.add_user("ada")
        yield running


def _await(is_so: Callable[[], object]) -> None:
    end = time.monotonic() + 20.0
    while not is_so():
        assert time.monotonic() < end
        time.sleep(0.02)


@contextmanager
def sending(stream) -> Iterator[None]:
    """Send a person at 30 Hz from a thread until the block ends."""
    stop = threading.Event()

    def send() -> None:
        for pose in POSES:
            stream.send(pose)
            if stop.wait(1 / 30):
                return

    thread = threading.Thread(target=send)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def test_callbacks_get_every_kind_of_news_and_their_mistakes_stop_nothing(server):
    seen, events = [], []

    def use(forecast) -> None:
        seen.append(forecast.seq)
        if len(seen) == 3:
            raise ZeroDivisionError

    with (
        Client(server.http, ADMIN_KEY) as client,
        client.stream("ada", on_forecast=use, on_event=events.append) as stream,
        sending(stream),
    ):
        _await(lambda: len(seen) >= 10)
        assert stream.statistics().callback_errors == 1
    assert seen == sorted(set(seen))
    assert isinstance(events[0], Connected)
    assert any(isinstance(event, Waiting) for event in events)


def test_a_slow_callback_gets_the_newest_forecast(server):
    ages = []

    def dawdle(forecast) -> None:
        ages.append(forecast.age_s)
        time.sleep(0.3)

    with (
        Client(server.http, ADMIN_KEY) as client,
        client.stream("ada", on_forecast=dawdle) as stream,
        sending(stream),
    ):
        _await(lambda: len(ages) >= 5)
        assert stream.statistics().forecasts > len(ages)
    assert max(ages) < 1.0  # in turn, the fifth would have waited for longer


def test_iteration_gives_every_forecast_once_and_ends_with_the_stream(server):
    with (
        Client(server.http, ADMIN_KEY) as client,
        client.stream("ada") as stream,
        sending(stream),
    ):
        numbers = []
        for forecast in stream:
            numbers.append(forecast.seq)
            if len(numbers) == 10:
                stream.close()
        assert numbers == sorted(set(numbers))
        assert len(numbers) == 10
        assert list(stream) == []
        assert stream.wait(0.1) is None
        with pytest.raises(UnreachableError, match="closed"):
            stream.open(0.1)


def test_waiting_has_an_end(server):
    with Client(server.http, ADMIN_KEY) as client, client.stream("ada") as stream:
        begin = time.monotonic()
        assert stream.wait(0.2) is None
        for forecast in stream.forecasts(timeout_s=0.1):
            assert forecast is None
            break
        assert 0.29 < time.monotonic() - begin < 5.0


def test_one_recording_at_a_time(server):
    with Client(server.http, ADMIN_KEY) as client, client.stream("ada") as stream:
        recording = stream.record()
        with pytest.raises(RecordingError, match="being recorded"):
            stream.record()
        recording.cancel()
        with pytest.raises(KeyError), stream.record("broken off") as other:
            JOINTS_BY_NAME["tail"]
        assert other.status.state == "stored"
        assert other.status.job is None  # stored, and not trained on
        stream.close()
        with pytest.raises(StoppedError, match="closed"):
            stream.record().stop(timeout_s=1.0)


def test_a_key_that_may_not_record_says_so(server):
    key = server.add_key("predict", user="ada")["key"]
    with Client(server.http, key) as client, client.stream("ada") as stream:
        with pytest.raises(RecordingError, match="scope record") as refused:
            stream.record().stop()
        assert refused.value.code == "forbidden"
        with pytest.raises(RecordingError), stream.record() as other:
            _await(lambda: other.status.is_over)
        assert stream.state == "open"


def test_a_refusal_is_raised_by_whatever_waits(server):
    with Client(server.http, "a-key-that-nobody-made") as client:
        stopped = []
        stream = client.stream("ada", on_event=stopped.append)
        with pytest.raises(RefusedError, match="unauthorized"):
            stream.open()
        with pytest.raises(RefusedError):
            stream.check()
        with pytest.raises(RefusedError):
            stream.wait(1.0)
        with pytest.raises(RefusedError):
            next(iter(stream))
        assert stream.latest() is None
        assert stream.state == "stopped"
        _await(lambda: stopped)
        assert isinstance(stopped[-1], Stopped)


@pytest.mark.asyncio
async def test_the_same_with_an_event_loop(server):
    events, seen = [], []

    async def use(forecast) -> None:
        seen.append(forecast.seq)
        await asyncio.sleep(0)
        if len(seen) == 2:
            raise ZeroDivisionError

    async with AsyncClient(server.http, ADMIN_KEY) as client:
        async with client.stream("ada", on_forecast=use, on_event=events.append) as stream:
            assert stream.joints == JOINTS
            sender = asyncio.create_task(_send(stream))
            async with stream.record("async", trial=None) as recording:
                recording.clip("wave")
                numbers = []
                async for forecast in stream:
                    numbers.append(forecast.seq)
                    if len(numbers) == 10:
                        break
                forecast = await stream.wait(2.0)
                recording.pause()
            assert recording.status.state == "stored"
            mistake = stream.record()
            assert (await mistake.cancel()).state == "cancelled"
            with pytest.raises(RecordingError):
                await asyncio.gather(_record_twice(stream))
            sender.cancel()
            stream.reset()
            assert stream.latest() is None
            assert await stream.wait(0.1) is None
            async for nothing in stream.forecasts(timeout_s=0.1):
                assert nothing is None
                break
        assert stream.state == "closed"
        assert [forecast async for forecast in stream] == []
    assert numbers == sorted(set(numbers))
    assert len(seen) >= 10
    assert stream.statistics().callback_errors == 1
    assert isinstance(events[0], Connected)
    assert forecast.frames.shape == (15, 20, 3)


async def _send(stream) -> None:
    for pose in POSES:
        stream.send(pose)
        await asyncio.sleep(1 / 30)


async def _record_twice(stream) -> None:
    first = stream.record()
    try:
        stream.record()
    finally:
        await first.cancel()


@pytest.mark.asyncio
async def test_every_request_works_with_an_event_loop(server, tmp_path):
    async with AsyncClient(server.http, ADMIN_KEY) as client:
        assert await client.is_ready()
        assert (await client.users.add("lin")).id == "lin"
        with pytest.raises(ConflictError):
            await client.users.add("lin")
        assert (await client.users.rename("lin", "Lin")).display_name == "Lin"
        assert not (await client.users.set_auto_promote("lin", on=False)).auto_promote
        assert (await client.users.get("lin")).skeleton == "kinect_v1"
        assert {user.id async for user in client.users.list()} == {"ada", "lin"}
        forecast = await client.forecast("lin", POSES[:30], np.arange(30) / 30)
        assert forecast.t_observed == pytest.approx(29 / 30)
        stored = await client.trials.upload("lin", [Clip(POSES[:60], action="wave")])
        path = tmp_path / "trial.csv"
        names = [f"{joint}.{axis}" for joint in JOINTS for axis in "xyz"]
        rows = [",".join(map(str, pose.ravel())) for pose in POSES[:60]]
        path.write_text("\n".join([",".join(names), *rows]))
        filed = await client.trials.upload_files("lin", [path], label="csv", finetune=False)
        assert filed.trial.frames == 60
        listed = [trial.id async for trial in client.trials.list("lin")]
        assert listed == [filed.trial.id, stored.trial.id]
        assert (await client.trials.get("lin", stored.trial.id)).details[0].action == "wave"
        await client.trials.delete("lin", filed.trial.id)
        job = await client.jobs.start("lin")
        assert job.id == stored.job.id
        with pytest.raises(DeadlineError, match="still queued"):
            await client.jobs.wait(job.id, 0.1)
        assert [one.id async for one in client.jobs.list(user="lin")] == [job.id]
        assert (await client.jobs.cancel(job.id)).state == "cancelled"
        assert (await client.jobs.wait(job.id, 5.0)).is_over
        assert (await client.jobs.get(job.id)).state == "cancelled"
        assert [version async for version in client.versions.list("lin")] == []
        for act in (client.versions.get, client.versions.promote):
            with pytest.raises(NotFoundError):
                await act("lin", 7)
        assert (await client.versions.rollback("lin")).number == 0
        await client.users.delete("lin")
    with pytest.raises(RuntimeError):
        client.stream("lin")


def test_lists_go_on_over_their_pages(server, monkeypatch):
    monkeypatch.setattr("kinecast_client.resources.PAGE", 2)
    with Client(server.http, ADMIN_KEY) as client:
        for number in range(5):
            client.users.add(f"page-{number}")
        listed = [user.id for user in client.users.list() if user.id.startswith("page-")]
    assert listed == [f"page-{number}" for number in reversed(range(5))]


def test_nobody_at_the_address_is_said_so():
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    with Client(f"http://127.0.0.1:{port}", "key") as client:
        assert not client.is_ready()
        with pytest.raises(UnreachableError):
            client.users.get("ada")
        with pytest.raises(UnreachableError, match="No stream of ada"):
            client.stream("ada").open(timeout_s=0.3)


def test_a_defect_costs_a_connection_and_not_the_stream(server, monkeypatch):
    dials = []

    def stumble(*arguments) -> str:
        dials.append(arguments)
        if len(dials) < 3:
            raise ZeroDivisionError("a defect")
        return real(*arguments)

    from kinecast_client import link

    real = link.find_stream_url
    monkeypatch.setattr(link, "find_stream_url", stumble)
    with Client(server.http, ADMIN_KEY) as client, client.stream("ada") as stream:
        assert stream.state == "open"
    assert len(dials) == 3


def test_a_program_ends_though_it_closed_nothing(server):
    program = (
        "import sys; from kinecast_client import Client\n"
        "stream = Client(sys.argv[1], sys.argv[2]).stream('ada', on_forecast=print).open()\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, server.http, ADMIN_KEY],
        env=dict(os.environ) | {"PYTHONPATH": str(ROOT / "clients/python/src")},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_the_reason_of_a_close_is_read_though_frames_are_on_their_way(server):
    """Frames that are sent into a connection which is closing must not hide why it closes."""
    for number in range(5):
        user = f"brief-{number}"
        server.add_user(user)
        with Client(server.http, ADMIN_KEY) as client, client.stream(user) as stream:
            with sending(stream):
                client.users.delete(user)
                _await(lambda: stream.state == "stopped")
            with pytest.raises(UserDeletedError, match="user_deleted"):
                stream.check()
