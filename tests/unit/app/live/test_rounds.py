import asyncio

import pytest
from structlog.testing import capture_logs

from app.live.rounds import TELL_EVERY_S, Mistakes, Rounds


class Counter:
    def __init__(self) -> None:
        self.steps, self.pauses = 0, []
        self.news = asyncio.Event()

    async def step(self) -> None:
        self.steps += 1

    async def pause(self, seconds: float) -> None:
        self.pauses.append(seconds)
        await self.news.wait()
        self.news.clear()


@pytest.mark.asyncio
async def test_a_step_follows_every_pause_until_it_is_stopped() -> None:
    counter = Counter()
    rounds = Rounds(counter.step, every_s=7.0, listen=lambda: counter.pause)
    rounds.start()
    for expected in range(3):
        await asyncio.sleep(0)
        assert counter.steps == expected
        counter.news.set()
        await asyncio.sleep(0.01)
    await rounds.stop()
    counter.news.set()
    await asyncio.sleep(0.01)
    assert counter.steps == 3
    assert counter.pauses == [7.0] * 4


@pytest.mark.asyncio
async def test_stopping_interrupts_a_step_and_may_be_repeated() -> None:
    begun = asyncio.Event()

    async def step() -> None:
        begun.set()
        await asyncio.sleep(60)

    rounds = Rounds(step, every_s=0.0)
    rounds.start()
    await begun.wait()
    await asyncio.wait_for(rounds.stop(), 1.0)
    await rounds.stop()


@pytest.mark.asyncio
async def test_a_step_that_raises_ends_neither_the_rounds_nor_their_end() -> None:
    steps = []

    async def step() -> None:
        steps.append(len(steps))
        if len(steps) < 4:
            raise LookupError("a mistake")

    rounds = Rounds(step, every_s=0.001)
    with capture_logs() as logs:
        rounds.start()
        async with asyncio.timeout(5):
            while len(steps) < 6:  # noqa: ASYNC110 - it waits for rounds
                await asyncio.sleep(0.001)
        await rounds.stop()
    assert [line["where"].rpartition(".")[2] for line in logs] == ["step"]
    assert isinstance(logs[0]["exc_info"], LookupError)


@pytest.mark.asyncio
async def test_a_pause_that_raises_is_a_mere_sleep() -> None:
    done = asyncio.Event()

    async def pause(seconds: float) -> None:
        raise OSError("no news")

    async def step() -> None:
        done.set()

    rounds = Rounds(step, every_s=0.001, listen=lambda: pause)
    rounds.start()
    await asyncio.wait_for(done.wait(), 5)
    await rounds.stop()


@pytest.mark.asyncio
async def test_a_step_that_turns_its_cancellation_into_an_error_can_be_stopped() -> None:
    begun = asyncio.Event()

    async def step() -> None:
        begun.set()
        try:
            await asyncio.sleep(60)
        except asyncio.CancelledError:
            raise OSError("the connection is lost") from None

    rounds = Rounds(step, every_s=0.0)
    rounds.start()
    await begun.wait()
    await asyncio.wait_for(rounds.stop(), 1.0)


def test_a_mistake_that_repeats_is_logged_now_and_then() -> None:
    now = 100.0
    mistakes = Mistakes("here", lambda: now)
    with capture_logs() as logs:
        for _ in range(3):
            mistakes.tell(LookupError("a"))
        mistakes.tell(OSError("another"))
        now += TELL_EVERY_S
        mistakes.tell(LookupError("a"))
    assert [str(line["exc_info"]) for line in logs] == ["a", "another", "a"]
    assert [line["untold"] for line in logs] == [0, 2, 0]
