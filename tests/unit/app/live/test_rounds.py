import asyncio

import pytest

from app.live.rounds import Rounds

pytestmark = pytest.mark.asyncio


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


async def test_what_ended_the_rounds_is_raised_and_not_forgotten() -> None:
    async def step() -> None:
        raise LookupError("a mistake")

    rounds = Rounds(step, every_s=0.0)
    rounds.start()
    await asyncio.sleep(0.01)
    with pytest.raises(LookupError, match="a mistake"):
        await rounds.stop()
