"""The load generator: what it says and hears, what it notes, and when it wakes up."""

import asyncio
import time

import msgspec
import numpy as np
import pytest

from app.commands.bench.accounts import Accounts, StreamLog, measure_shares
from app.commands.bench.clockwork import run_precisely
from app.commands.bench.generator import Schedule
from app.commands.bench.wire import Answer, LeanWire
from app.commands.client.messages import JSON, MSGPACK, Error, Ping, Timing, Waiting, Wire
from app.live.codec import Codec
from app.live.protocol import ClientPong, Observation

POSES = np.random.default_rng(0).normal(size=(3, 20, 3)).astype(np.float32)


@pytest.mark.parametrize("subprotocol", [JSON, MSGPACK])
@pytest.mark.parametrize("seq", [0, 200, 70_000])
def test_prepared_frames_are_what_a_client_says(subprotocol: str, seq: int) -> None:
    wire, codec = LeanWire(subprotocol), Codec(subprotocol, joints=20)
    prepared = wire.prepare(POSES)
    for pose, ready in zip(POSES, prepared, strict=True):
        data = wire.encode_frame(seq, 12.345678, ready)
        frame = codec.decode(data.decode() if subprotocol == JSON else data)
        assert isinstance(frame, Observation)
        assert (frame.seq, frame.t) == (seq, 12.345678)
        np.testing.assert_allclose(frame.joints, pose, atol=1e-6)


@pytest.mark.parametrize("subprotocol", [JSON, MSGPACK])
def test_messages_are_read_as_far_as_they_matter(subprotocol: str) -> None:
    wire, say = LeanWire(subprotocol), Wire(subprotocol).encode

    def hear(kind: str, **fields: object) -> object:
        said = say(kind, **fields)
        return wire.decode(memoryview(said.encode() if isinstance(said, str) else said))

    timing = {"queue_ms": 1.0, "compute_ms": 2.0, "total_ms": 3.0}
    heard = hear("forecast", seq=7, skipped=2, timing=timing, frames=[[1.0]], version={"a": 1})
    assert heard == Answer(7, 2, Timing(1.0, 2.0, 3.0))
    waiting = hear("waiting", seq=1, t=0.0, reason="warm_up", have_s=0.1, need_s=0.45)
    assert isinstance(waiting, Waiting)
    assert isinstance(hear("error", code="bad_frame", message="no", seq=3), Error)
    assert hear("trial", state="stored") is hear("news of tomorrow") is None
    ping = hear("ping", id=4, server_t=1.5)
    assert isinstance(ping, Ping)
    pong = wire.encode_pong(ping, 9.5)
    decoded = Codec(subprotocol, joints=20).decode(pong.decode() if subprotocol == JSON else pong)
    assert decoded == ClientPong(4, 1.5, 9.5)
    for broken in ("forecast", "waiting"):
        with pytest.raises(msgspec.DecodeError):
            hear(broken)
    with pytest.raises(msgspec.DecodeError):
        wire.decode(b"\xc1")


def answer(seq: int, skipped: int = 0) -> Answer:
    return Answer(seq, skipped, Timing(0.5, 1.5, 2.0))


def send(accounts: Accounts, *seqs: int) -> None:
    for seq in seqs:
        accounts.note_sent(seq, due=float(seq), now=seq + 0.25)


def test_every_frame_is_accounted_for_once() -> None:
    accounts = Accounts(log := StreamLog())
    send(accounts, *range(10))
    accounts.note_waiting(0)
    accounts.note_waiting(1)
    accounts.note_answer(answer(3), 3.5)  # 0, 1 and 2 were waiting
    accounts.note_answer(answer(6, skipped=1), 6.5)  # 4 or 5 was told of, the other was not
    accounts.note_refused(7, "stale_frame", 7.5)
    accounts.note_answer(answer(8), 8.5)
    accounts.close(12.0)  # 9 is still open
    assert log.answers[0] == (3.0, 3.5, 0.5, 1.5)
    assert [len(log.answers), log.covered, log.skipped, log.lost] == [3, 3, 1, 2]
    assert log.refused == {"stale_frame": 1}
    assert log.sent == 10 == len(log.late_s)
    assert log.failures == [(4.0, 6.5), (5.0, 6.5), (7.0, 7.5), (9.0, 12.0)]


def test_frames_of_somebody_who_left_do_not_count() -> None:
    accounts = Accounts(log := StreamLog())
    send(accounts, 0, 1)
    accounts.note_answer(answer(0), 0.5)
    accounts.leave()
    accounts.close(5.0)
    assert (log.left, log.lost, log.failures) == (1, 0, [])
    assert measure_shares([log]) == [1.0]


def test_shares_are_of_frames_that_could_be_answered() -> None:
    good = StreamLog(sent=20, covered=10, answers=[(0.0, 0.1, 0.0, 0.0)] * 10)
    bad = StreamLog(sent=10, answers=[(0.0, 0.1, 0.0, 0.0)] * 4)
    assert measure_shares([good, bad, StreamLog()]) == [1.0, 0.4]


class Robot:
    """A client that only notes when it was told to send."""

    def __init__(self) -> None:
        self.sent: list[tuple[int, float, float]] = []

    def send(self, seq: int, due: float, now: float) -> None:
        self.sent.append((seq, due, now))


def test_frames_leave_on_their_schedule_even_after_a_stall() -> None:
    robots = [Robot() for _ in range(4)]

    async def main() -> float:
        start = time.monotonic() + 0.02
        schedule = Schedule([robot.send for robot in robots], frames=6, start=start)
        asyncio.get_running_loop().call_at(start, schedule.send_due)
        await asyncio.sleep(0.05)
        time.sleep(0.05)  # noqa: ASYNC251 - the generator itself is held up
        await schedule.sent
        return start

    start = run_precisely(main())
    for n, robot in enumerate(robots):
        assert [seq for seq, _, _ in robot.sent] == list(range(6))
        dues = [due for _, due, _ in robot.sent]
        np.testing.assert_allclose(dues, start + n / 120 + np.arange(6) / 30, atol=1e-9)
        assert all(now >= due for _, due, now in robot.sent)


def test_timers_are_precise() -> None:
    async def main() -> list[float]:
        loop, late = asyncio.get_running_loop(), []
        for i in range(100):
            woken = loop.create_future()
            due = loop.time() + 0.0013 + i * 1e-5
            loop.call_at(due, woken.set_result, None)
            await woken
            late.append(loop.time() - due)
        return late

    late = sorted(run_precisely(main()))
    assert late[0] >= -1e-6
    assert late[20] < 0.0004  # others use this machine too


def test_files_are_served_while_nothing_is_due() -> None:
    async def main() -> bytes:
        async def greet(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            writer.write(b"hello")
            writer.close()

        server = await asyncio.start_server(greet, "127.0.0.1", 0)
        reader, writer = await asyncio.open_connection(*server.sockets[0].getsockname())
        said = await asyncio.wait_for(reader.read(), 5)
        writer.close()
        server.close()
        return said

    assert run_precisely(main()) == b"hello"
