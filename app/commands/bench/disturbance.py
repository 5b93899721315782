"""What reaches a service besides the streams: versions promoted, trials uploaded.

It comes from a process of its own, so that it costs the load generator nothing.
"""

import asyncio
import multiprocessing
import time
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any
from uuid import uuid4

from app.commands.bench.scenarios import Scenario
from app.commands.client.errors import ApiError, ClientError
from app.commands.client.rest import Api
from app.commands.target import Target

SWAPS_HZ_EACH = 0.1
"""Promotions in a second, for each user."""
TRAINEE = "bench-trainee"
CLIP_S = 5.2
ACTIONS = ("walk", "wave", "squat")
POLL_S = 1.0
START_S = 60.0
_FINAL = frozenset({"succeeded", "rejected", "failed", "cancelled"})


@dataclass(slots=True)
class Counts:
    """What was done: promotions, and fine-tuning jobs begun and ended."""

    promotions: int = 0
    jobs_begun: int = 0
    jobs_ended: int = 0


@asynccontextmanager
async def disturbing(
    target: Target, users: Sequence[str], scenarios: frozenset[Scenario]
) -> AsyncIterator[dict[str, Any]]:
    """Disturb a service until the block ends; what was done is in the dictionary then.

    Args:
        target: the service, with an admin key.
        users: who streams; everybody has versions 1 and 2 where they are to be swapped.
        scenarios: of them those that are not the clients' own.

    Raises:
        ClientError: the service refused, or what disturbs it did not start.
    """
    done: dict[str, Any] = {}
    wanted = scenarios & {Scenario.SWAPS, Scenario.FINETUNE}
    if not wanted:
        yield done
        return
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    process = context.Process(
        target=_disturb, args=(there, target, tuple(users), wanted), daemon=True
    )
    process.start()
    there.close()
    try:
        await asyncio.to_thread(_await_word, here)
        yield done
        with suppress(OSError):
            here.send("stop")
        done |= await asyncio.to_thread(_await_word, here)
    finally:
        process.terminate()
        await asyncio.to_thread(process.join)
        here.close()


def _await_word(here: Connection) -> Any:  # noqa: ANN401 - what the process says
    """Wait for what the process says next; an error that it met is raised."""
    try:
        word = here.recv() if here.poll(START_S) else ClientError("What disturbs did not answer.")
    except EOFError:
        word = ClientError("What was to disturb the service ended.")
    if isinstance(word, Exception):
        raise word
    return word


def _disturb(
    there: Connection, target: Target, users: Sequence[str], scenarios: frozenset[Scenario]
) -> None:
    """Disturb until told to stop: the whole life of the process."""
    try:
        there.send(asyncio.run(_disturb_all(there, target, users, scenarios)))
    except (ClientError, ExceptionGroup) as error:
        there.send(ClientError(f"The service could not be disturbed: {error}"))


async def _disturb_all(
    there: Connection, target: Target, users: Sequence[str], scenarios: frozenset[Scenario]
) -> dict[str, int]:
    counts = Counts()
    async with Api(target.url, key=target.key, wait_s=START_S) as api:
        tasks = []
        if Scenario.SWAPS in scenarios:
            tasks.append(asyncio.create_task(swap(api, users, counts)))
        if Scenario.FINETUNE in scenarios:
            body = _record()
            await api.add_user(TRAINEE)
            tasks.append(asyncio.create_task(train(api, body, counts)))
        there.send("ready")
        told = asyncio.create_task(asyncio.to_thread(there.recv))
        ended, _ = await asyncio.wait({told, *tasks}, return_when=asyncio.FIRST_COMPLETED)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        for task in ended - {told}:
            task.result()
        if Scenario.FINETUNE in scenarios:
            with suppress(ApiError):
                await api.delete_user(TRAINEE)
    return {
        name: getattr(counts, name)
        for name, scenario in (
            ("promotions", Scenario.SWAPS),
            ("jobs_begun", Scenario.FINETUNE),
            ("jobs_ended", Scenario.FINETUNE),
        )
        if scenario in scenarios
    }


async def swap(api: Api, users: Sequence[str], counts: Counts) -> None:
    """Promote the other one of everybody's two versions, one user after the other, for ever."""
    start, pause_s = time.monotonic(), 1 / (SWAPS_HZ_EACH * len(users))
    turn = 0
    while True:
        round_number, user = divmod(turn, len(users))
        await api.promote(users[user], 1 + round_number % 2)
        counts.promotions += 1
        turn += 1
        await asyncio.sleep(max(0.0, start + turn * pause_s - time.monotonic()))


async def train(api: Api, body: bytes, counts: Counts) -> None:
    """Upload the same trial as soon as the job of the one before has ended, for ever."""
    while True:
        answer = await api.add_trial(
            TRAINEE, body, media_type="application/msgpack", token=uuid4().hex
        )
        job = answer["job"]
        counts.jobs_begun += 1
        while job["state"] not in _FINAL:
            await asyncio.sleep(POLL_S)
            job = await api.get_job(job["id"])
        counts.jobs_ended += 1


def _record() -> bytes:
    """Make the request that uploads one synthetic person's trial."""
    from app.commands.import_ import make_body  # noqa: PLC0415 - slow to import
    from models.data.clips import Clip  # noqa: PLC0415
    from models.data.synthetic import SyntheticPerson  # noqa: PLC0415

    person = SyntheticPerson(0)
    clips = [
        Clip(person.record(action, CLIP_S, noise=True), "0", action, "1", "synthetic")
        for action in ACTIONS
    ]
    return make_body("bench", clips, finetune=True).content
