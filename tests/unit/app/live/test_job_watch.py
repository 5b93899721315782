"""What streams are told of jobs, and how often anybody asks."""

from collections.abc import Collection, Sequence
from dataclasses import replace
from uuid import UUID, uuid4

import pytest

from app.domain.errors import NotReadyError
from app.domain.jobs import JobState
from app.domain.streams import JobNews, OpenStream
from app.live.job_watch import JobWatch

pytestmark = pytest.mark.asyncio
ADA, BOB = uuid4(), uuid4()
JOB = JobNews(uuid4(), ADA, JobState.QUEUED, None, None)


class Listener:
    def __init__(self, user: UUID, session: str) -> None:
        self.stream = OpenStream(user_uuid=user, key_id=uuid4(), session=session, epoch=1)
        self.heard: list[JobNews] = []

    def tell_job(self, news: JobNews) -> None:
        self.heard.append(news)


class Rig:
    """A watch, what there is to tell, and what was asked for."""

    def __init__(self) -> None:
        self.listeners: list[Listener] = []
        self.news: list[JobNews] = []
        self.asked: list[tuple[set[UUID], set[UUID]]] = []
        self.is_away = False
        self.now = 0.0
        self.watch = JobWatch(self.read, lambda: self.listeners)

    async def read(self, users: Collection[UUID], known: Collection[UUID]) -> Sequence[JobNews]:
        self.asked.append((set(users), set(known)))
        if self.is_away:
            raise NotReadyError
        return self.news

    async def look(self, *news: JobNews, later: float = 1.0) -> None:
        self.news = list(news)
        self.now += later
        await self.watch.look(self.now)


@pytest.fixture
def rig() -> Rig:
    rig = Rig()
    rig.listeners = [Listener(ADA, "a"), Listener(ADA, "b"), Listener(BOB, "c")]
    return rig


async def test_without_streams_nobody_asks(rig) -> None:
    rig.listeners = []
    await rig.look(JOB)
    assert rig.asked == []


async def test_one_question_serves_all_streams_and_each_hears_of_its_own(rig) -> None:
    await rig.look(JOB)
    assert rig.asked == [({ADA, BOB}, set())]
    assert [one.heard for one in rig.listeners] == [[JOB], [JOB], []]


async def test_only_what_changes_is_told_and_progress_once_a_second(rig) -> None:
    (one, *_) = rig.listeners
    running = replace(JOB, state=JobState.RUNNING, progress={"step": 1})
    await rig.look(JOB)
    await rig.look(JOB)
    await rig.look(running, later=0.1)
    await rig.look(replace(running, progress={"step": 2}), later=0.5)
    await rig.look(replace(running, progress={"step": 3}), later=0.6)
    assert [news.progress for news in one.heard] == [None, {"step": 1}, {"step": 3}]
    assert rig.asked[-1] == ({ADA, BOB}, {JOB.id})


async def test_the_end_is_told_once_and_at_once(rig) -> None:
    (one, *_) = rig.listeners
    ended = replace(JOB, state=JobState.SUCCEEDED, metrics={"won": 3})
    await rig.look(JOB)
    for _ in range(3):
        await rig.look(ended, later=0.1)
    await rig.look(later=0.1)
    assert one.heard == [JOB, ended]
    assert rig.asked[-1] == ({ADA, BOB}, set())


async def test_a_stream_that_opens_later_hears_how_things_stand(rig) -> None:
    await rig.look(JOB)
    late = Listener(ADA, "late")
    rig.listeners.append(late)
    await rig.look(JOB)
    assert late.heard == [JOB]


async def test_an_outage_loses_no_news(rig) -> None:
    (one, *_) = rig.listeners
    await rig.look(JOB)
    rig.is_away = True
    await rig.look()
    rig.is_away = False
    ended = replace(JOB, state=JobState.FAILED)
    await rig.look(ended)
    assert rig.asked[-1][1] == {JOB.id}
    assert one.heard == [JOB, ended]
