import asyncio
import json
import time
from collections.abc import AsyncIterator
from uuid import uuid4

import pytest
import pytest_asyncio

from app.domain.errors import DrainingError, KinecastError, NotReadyError
from app.domain.streams import OpenStream
from app.live.codec import Codec
from app.live.connection import SETTLE_S, STALL_S, Connection, GoneError, Take
from app.live.decoders import Decoders
from app.live.engine import Engine
from app.live.outbox import FULL, Outbox
from app.live.protocol import JSON, Bye
from app.live.session import Session
from app.live.steps import Outcome, Step
from models.baselines import ZeroVelocity
from tests.unit.app.live.recorder_rig import ListArchive
from tests.unit.app.live.test_session import PERSON, make_session

CODEC = Codec(JSON, joints=20)


def write_frame(seq: int) -> str:
    joints = PERSON[seq % 60].tolist()
    return json.dumps({"type": "frame", "seq": seq, "t": seq / 30, "joints": joints})


class FakeSocket:
    """A client in memory: it sends what it is given and may stop taking anything."""

    def __init__(self) -> None:
        self.inbox: asyncio.Queue[str | None] = asyncio.Queue()
        self.taken: list[dict[str, object]] = []
        self.reads = asyncio.Event()
        self.reads.set()
        self.refused: KinecastError | None = None
        self.take: Take | None = None
        self.is_clear = False

    async def receive(self) -> str | bytes:
        data = await self.inbox.get()
        if data is None:
            raise GoneError
        return data

    async def send(self, data: bytes) -> None:
        await self.reads.wait()
        self.taken.append(json.loads(data))

    async def refuse(self, error: KinecastError, codec: Codec) -> None:
        await self.reads.wait()
        self.refused = error

    def listen(self, take: Take | None) -> None:
        self.take = take

    def send_now(self, data: bytes) -> None:
        assert self.is_clear
        self.taken.append(json.loads(data))

    def show(self, seq: int) -> None:
        self.inbox.put_nowait(write_frame(seq))


class MemoryArchive:
    """A database in memory, which may be slow, or away for some steps."""

    def __init__(self) -> None:
        self.rig = ListArchive()
        self.answers = asyncio.Event()
        self.answers.set()
        self.failures = 0

    async def __call__(self, step: Step) -> Outcome:
        await self.answers.wait()
        if self.failures:
            self.failures -= 1
            raise NotReadyError
        return self.rig.perform(step)


class Fixture:
    def __init__(self, engine: Engine) -> None:
        self.socket = FakeSocket()
        self.session: Session = make_session(now=time.monotonic())
        stream = OpenStream(user_uuid=uuid4(), key_id=uuid4(), session="s", epoch=1)
        self.archive = MemoryArchive()
        self.connection = Connection(
            self.socket, CODEC, self.session, engine, stream, archive=self.archive
        )
        self.task = asyncio.create_task(self.connection.run())

    async def until(self, condition) -> None:
        async with asyncio.timeout(10):
            while not condition():  # noqa: ASYNC110 - it waits for what the client has seen
                await asyncio.sleep(0.002)


@pytest_asyncio.fixture
async def live() -> AsyncIterator[Fixture]:
    engine = Engine(Decoders(ZeroVelocity(15), base_sha256="ab"), batch=2)
    engine.start()
    engine.wait_ready(10.0)
    fixture = Fixture(engine)
    yield fixture
    fixture.task.cancel()
    await asyncio.gather(fixture.task, return_exceptions=True)
    engine.stop()


@pytest.mark.asyncio
async def test_frames_go_through_the_engine_and_come_back(live: Fixture) -> None:
    for seq in range(16):
        live.socket.show(seq)
    await live.until(lambda: live.socket.taken[-1:] and live.socket.taken[-1].get("seq") == 15)
    assert live.socket.taken[0]["type"] == "hello"
    assert live.socket.taken[-1]["type"] == "forecast"
    live.socket.inbox.put_nowait(None)
    await live.task
    assert live.connection.closed.is_set()


@pytest.mark.asyncio
async def test_frames_are_taken_and_answered_without_a_tasks_turn(live: Fixture) -> None:
    await live.until(lambda: live.socket.taken)  # the hello has left
    live.socket.is_clear = True
    assert live.socket.take is not None
    for seq in range(16):
        assert live.socket.take(write_frame(seq))
    await live.until(lambda: live.socket.taken[-1].get("seq") == 15)
    assert live.socket.taken[-1]["type"] == "forecast"
    assert not live.connection._outbox


@pytest.mark.asyncio
async def test_what_may_have_to_wait_is_left_to_the_task(live: Fixture) -> None:
    await live.until(lambda: live.socket.taken)
    assert live.socket.take is not None
    assert not live.socket.take('{"type": "configure", "forecast_every": 2}')
    live.connection._is_busy = True
    assert not live.socket.take(write_frame(0))
    live.connection._is_busy = False
    live.connection.end(DrainingError())
    assert not live.socket.take(write_frame(0))


@pytest.mark.asyncio
@pytest.mark.parametrize("where", ["receive", "answer"])
async def test_a_defect_ends_the_stream_and_not_the_server(
    live: Fixture, where: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise ZeroDivisionError

    await live.until(lambda: live.socket.taken)
    live.socket.is_clear = True
    monkeypatch.setattr(Session, where, fail)
    assert live.socket.take is not None
    for seq in range(16):
        live.socket.take(write_frame(seq))
    take = live.socket.take
    with pytest.raises(ZeroDivisionError):
        await live.task
    assert live.connection.closed.is_set()
    assert live.socket.take is None
    assert not take(write_frame(16))


@pytest.mark.asyncio
async def test_a_client_that_takes_nothing_keeps_one_forecast_and_is_given_up(
    live: Fixture,
) -> None:
    for seq in range(15):
        live.socket.show(seq)
    await live.until(lambda: len(live.socket.taken) >= 3)
    live.socket.reads.clear()
    outbox = live.connection._outbox
    for seq in range(15, 60):
        live.socket.show(seq)
        await asyncio.sleep(0.005)
    await live.until(live.socket.inbox.empty)
    assert len(outbox) < 5
    live.connection.tick(time.monotonic())
    assert not live.task.done()
    live.connection.tick(time.monotonic() + STALL_S + 1)
    await live.until(live.connection.closed.is_set)
    assert live.task.done()


@pytest.mark.asyncio
async def test_replies_that_nobody_takes_hold_up_the_reader(live: Fixture) -> None:
    await live.until(lambda: live.socket.taken)
    live.socket.reads.clear()
    for i in range(FULL + 50):
        live.socket.inbox.put_nowait(json.dumps({"type": "ping", "id": i, "t": 0.0}))
    # the limit of messages a second ends it sooner or later; until then nothing piles up
    await asyncio.sleep(0.2)
    assert len(live.connection._outbox) <= FULL


@pytest.mark.asyncio
async def test_an_end_from_outside_is_told(live: Fixture) -> None:
    live.connection.end(DrainingError())
    await live.task
    assert isinstance(live.socket.refused, DrainingError)


@pytest.mark.asyncio
async def test_a_client_that_vanishes_ends_the_stream(live: Fixture) -> None:
    live.socket.inbox.put_nowait(None)
    await live.task
    assert live.socket.refused is None


@pytest.mark.asyncio
async def test_a_slow_database_does_not_delay_forecasts(live: Fixture) -> None:
    live.archive.answers.clear()
    live.socket.inbox.put_nowait(json.dumps({"type": "trial.start"}))
    for seq in range(40):
        live.socket.show(seq)
    await live.until(lambda: live.socket.taken[-1:] and live.socket.taken[-1].get("seq") == 39)
    assert not any(message["type"] == "trial" for message in live.socket.taken)
    live.archive.answers.set()
    await live.until(lambda: live.socket.taken[-1]["type"] == "trial")
    live.socket.inbox.put_nowait(None)
    await live.task
    (clip,) = live.archive.rig.clips.values()
    assert [frame.seq for frame in clip] == list(range(40))


@pytest.mark.asyncio
async def test_what_is_not_stored_at_the_end_is_tried_again(live: Fixture) -> None:
    live.socket.inbox.put_nowait(json.dumps({"type": "trial.start"}))
    await live.until(lambda: live.socket.taken[-1:] and live.socket.taken[-1]["type"] == "trial")
    live.archive.failures = 3
    for seq in range(40):
        live.socket.show(seq)
    live.socket.inbox.put_nowait(json.dumps({"type": "trial.stop"}))
    live.socket.inbox.put_nowait(None)
    await live.task
    (clip,) = live.archive.rig.clips.values()
    assert [frame.seq for frame in clip] == list(range(40))
    assert live.archive.rig.state == "stored"


@pytest.mark.asyncio
async def test_a_stream_does_not_wait_for_ever_for_its_last_frames(live: Fixture) -> None:
    live.archive.failures = 10**6
    live.socket.inbox.put_nowait(json.dumps({"type": "trial.start"}))
    live.socket.show(0)
    live.socket.inbox.put_nowait(None)
    began = time.monotonic()
    await live.task
    assert time.monotonic() - began < SETTLE_S + 0.5
    assert live.archive.rig.state is None


@pytest.mark.asyncio
async def test_an_outbox_gives_messages_in_order_and_the_newest_forecast() -> None:
    outbox = Outbox()
    outbox.put(Bye("a", 0.0))
    outbox.put(Bye("b", 0.0))
    await outbox.wait_for_something()
    assert [outbox.take_message().reason for _ in range(2)] == ["a", "b"]
    assert outbox.take_message() is None
    assert outbox.take_forecast() is None
    outbox.end(DrainingError())
    outbox.end(KinecastError())
    assert isinstance(outbox.ending, DrainingError)
