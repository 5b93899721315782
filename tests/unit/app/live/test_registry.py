import asyncio
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from uuid import UUID, uuid4

import pytest

from app.domain.errors import DrainingError, KinecastError, NotReadyError, TooFastError
from app.domain.motion import VersionStamp
from app.domain.streams import JobNews, OpenStream, Verdict
from app.domain.users import Lived
from app.live.registry import Registry
from app.live.telemetry import Telemetry
from app.live.work import Choice
from tests.unit.app.live.test_session import LIMITS

USER, KEY = uuid4(), uuid4()


class FakeStream:
    """An open stream that notes what is done to it."""

    def __init__(self, epoch: int = 1, *, session: str = "s", user: UUID = USER) -> None:
        self.stream = OpenStream(user_uuid=user, key_id=KEY, session=session, epoch=epoch)
        self.closed = asyncio.Event()
        self.ended: KinecastError | None = None
        self.unconfirmed = False
        self.ticks = 0
        self.choices: list[Choice] = []
        self.news: list[JobNews] = []

    def end(self, error: KinecastError) -> None:
        self.ended = error
        self.closed.set()

    def tick(self, now: float) -> None:
        self.ticks += 1

    def take_lived(self) -> Lived | None:
        return None

    def tell_job(self, news: JobNews) -> None:
        self.news.append(news)

    def switch(self, choice: Choice) -> None:
        self.choices.append(choice)

    def set_unconfirmed(self, *, unconfirmed: bool) -> None:
        self.unconfirmed = unconfirmed


class FakeDatabase:
    """Judges streams as it is told, or is away."""

    def __init__(self) -> None:
        self.verdicts: dict[OpenStream, Verdict] = {}
        self.away = False

    async def watch(self, streams: Sequence[OpenStream]) -> Mapping[OpenStream, Verdict]:
        if self.away:
            raise NotReadyError
        return {stream: self.verdicts[stream] for stream in streams if stream in self.verdicts}


@pytest.fixture
def database() -> FakeDatabase:
    return FakeDatabase()


@pytest.fixture
def registry(database: FakeDatabase) -> Registry:
    return Registry(database.watch, limits=LIMITS, telemetry=Telemetry())


@pytest.mark.asyncio
@pytest.mark.parametrize(
    ("verdict", "code"),
    [
        (Verdict.FENCED, "fenced"),
        (Verdict.USER_DELETED, "user_deleted"),
        (Verdict.KEY_REVOKED, "unauthorized"),
    ],
)
async def test_a_verdict_ends_its_stream_only(registry, database, verdict, code) -> None:
    judged, other = FakeStream(session="a"), FakeStream(session="b")
    database.verdicts[judged.stream] = verdict
    with registry.keep(judged), registry.keep(other):
        await registry.check(1.0)
    assert judged.ended.code == code
    assert other.ended is None


@pytest.mark.asyncio
async def test_a_newer_stream_fences_the_older_one_of_this_process_at_once(registry) -> None:
    old, elsewhere, new = FakeStream(1), FakeStream(1, user=uuid4()), FakeStream(2)
    with registry.keep(old), registry.keep(elsewhere), registry.keep(new):
        assert old.ended.code == "fenced"
        assert elsewhere.ended is None
        assert new.ended is None
        assert len(registry) == 3
    assert len(registry) == 0


@pytest.mark.asyncio
async def test_without_the_database_streams_are_flagged_and_then_closed(registry, database) -> None:
    stream = FakeStream()
    with registry.keep(stream):
        registry.start()
        begin = asyncio.get_running_loop().time()
        await registry.check(begin)
        database.away = True
        await registry.check(begin + 9)
        assert not stream.unconfirmed
        await registry.check(begin + 11)
        assert stream.unconfirmed
        database.away = False
        await registry.check(begin + 12)
        assert not stream.unconfirmed
        database.away = True
        await registry.check(begin + 71)
        assert stream.ended is None
        await registry.check(begin + 73)
        assert stream.ended.code == "not_ready"
        await registry.stop()


@pytest.mark.asyncio
async def test_streams_are_flagged_and_closed_while_a_question_hangs(database) -> None:
    async def hang(streams: Sequence[OpenStream]) -> Mapping[OpenStream, Verdict]:
        await asyncio.sleep(60)
        return {}

    registry = Registry(
        hang, limits=LIMITS, telemetry=Telemetry(), unconfirmed_s=0.2, close_s=0.4, watch_s=60.0
    )
    stream = FakeStream()
    with registry.keep(stream):
        asking = asyncio.create_task(registry.check(time.monotonic()))
        await registry._tick()
        assert not stream.unconfirmed
        await asyncio.sleep(0.25)
        await registry._tick()
        assert stream.unconfirmed
        await asyncio.sleep(0.2)
        await registry._tick()
        assert stream.ended.code == "not_ready"
        await asking


@pytest.mark.asyncio
async def test_streams_are_flagged_while_nobody_tells_what_is_active(database) -> None:
    is_away = True

    async def follow(users):
        if is_away:
            raise NotReadyError
        return {}

    registry = Registry(database.watch, limits=LIMITS, telemetry=Telemetry(), follow=follow)
    stream = FakeStream()
    with registry.keep(stream):
        begin = time.monotonic()
        for _ in range(2):
            await registry.follow()
        await registry.check(begin + 9)
        assert not stream.unconfirmed
        await registry.check(begin + 11)
        assert stream.unconfirmed
        await registry.check(begin + 90)
        assert stream.ended is None  # whose weights are to go is known
        is_away = False
        await registry.follow()
        await registry.check(begin + 91)
        assert not stream.unconfirmed


@pytest.mark.asyncio
async def test_keys_and_users_have_only_so_many_seats(registry) -> None:
    with ExitStack() as stack:
        for _ in range(LIMITS.streams_per_user):
            stack.enter_context(registry.take_seat(key_id=KEY, user_uuid=USER))
        with pytest.raises(TooFastError), registry.take_seat(key_id=uuid4(), user_uuid=USER):
            pass
        for _ in range(LIMITS.streams_per_key - LIMITS.streams_per_user):
            stack.enter_context(registry.take_seat(key_id=KEY, user_uuid=uuid4()))
        with pytest.raises(TooFastError), registry.take_seat(key_id=KEY, user_uuid=uuid4()):
            pass
    with registry.take_seat(key_id=KEY, user_uuid=USER):
        pass


@pytest.mark.asyncio
async def test_draining_ends_every_stream_and_lets_no_other_in(registry) -> None:
    streams = [FakeStream(session=str(i)) for i in range(3)]
    with registry.keep(streams[0]), registry.keep(streams[1]), registry.keep(streams[2]):
        await registry.drain(1.0)
        assert {stream.ended.code for stream in streams} == {"draining"}
    with pytest.raises(DrainingError), registry.keep(FakeStream()):
        pass
    with pytest.raises(DrainingError):
        registry.refuse_when_draining()


@pytest.mark.asyncio
async def test_streams_are_ticked(registry) -> None:
    stream = FakeStream()
    with registry.keep(stream):
        registry.start()
        await asyncio.sleep(1.3)
        await registry.stop()
    assert stream.ticks >= 1


@pytest.mark.asyncio
async def test_a_mistake_in_one_stream_harms_no_other(database) -> None:
    class Broken(FakeStream):
        def tick(self, now: float) -> None:
            raise LookupError("a mistake")

        def switch(self, choice: Choice) -> None:
            raise LookupError("a mistake")

    async def follow(users):
        return dict.fromkeys(users, Choice(VersionStamp(1, "personal", "ab")))

    registry = Registry(database.watch, limits=LIMITS, telemetry=Telemetry(), follow=follow)
    broken, healthy = Broken(session="a"), FakeStream(session="b")
    with registry.keep(broken), registry.keep(healthy):
        await registry._tick()
        await registry.follow()
    assert (healthy.ticks, len(healthy.choices)) == (1, 1)


@pytest.mark.asyncio
async def test_streams_go_over_to_what_is_active_for_their_user(database) -> None:
    mine, other, late = FakeStream(session="a"), FakeStream(session="b", user=uuid4()), FakeStream()
    choice = Choice(VersionStamp(1, "personal", "ab"))
    doors = ExitStack()

    async def follow(users):
        doors.enter_context(registry.keep(late))
        return dict.fromkeys(users - {other.stream.user_uuid}, choice)

    registry = Registry(database.watch, limits=LIMITS, telemetry=Telemetry(), follow=follow)
    with registry.keep(mine), registry.keep(other), doors:
        await registry.follow()
    assert mine.choices == [choice]
    assert other.choices == []
    assert late.choices == []  # it asked after the others did, and may know better
