"""When the demonstration records people, and what it makes of the answers."""

from typing import Any

import pytest

from app.commands.client.messages import Error, Job, Message, Trial
from app.commands.demo.trials import FIRST_AFTER, LENGTH, PAUSE, Rehearsals

pytestmark = pytest.mark.asyncio


class Stage:
    """A stream that notes what is sent, and a person who changes what they do."""

    def __init__(self) -> None:
        self.sent: list[tuple[int, str, dict[str, Any]]] = []
        self.rehearsals = Rehearsals()
        self.seq = 0

    async def send(self, kind: str, **fields: object) -> None:
        self.sent.append((self.seq, kind, fields))

    async def play(self, frames: int, action: str = "wave") -> None:
        for _ in range(frames):
            await self.rehearsals.before_frame(self, self.seq, action)
            self.seq += 1

    def hear(self, message: Message) -> None:
        self.rehearsals.hear(message, self.seq)

    def kinds(self) -> list[str]:
        return [kind for _, kind, _ in self.sent]


async def test_a_trial_has_a_clip_for_each_action() -> None:
    stage = Stage()
    await stage.play(FIRST_AFTER)
    assert stage.sent == []
    await stage.play(600, "wave")
    await stage.play(LENGTH - 600, "walk")
    await stage.play(10, "walk")
    assert [(kind, fields.get("action")) for _, kind, fields in stage.sent] == [
        ("trial.start", None),
        ("clip.start", "wave"),
        ("clip.start", "walk"),
        ("trial.stop", None),
    ]
    assert stage.rehearsals.told == "storing"


@pytest.mark.parametrize("is_late", [False, True])
async def test_the_next_trial_waits_for_the_job_of_the_last(is_late: bool) -> None:
    stage = Stage()
    await stage.play(FIRST_AFTER + LENGTH + 1)
    stored = Trial("stored", "t", job={"id": "j", "state": "queued"})
    messages = [stored, Job("j", "succeeded")]
    for message in reversed(messages) if is_late else messages:
        stage.hear(message)
    assert stage.rehearsals.told == "job succeeded"
    assert (stage.rehearsals.recorded, stage.rehearsals.jobs) == (1, {"succeeded": 1})
    await stage.play(PAUSE)
    assert stage.kinds().count("trial.start") == 1
    await stage.play(1)
    assert stage.kinds().count("trial.start") == 2


async def test_other_peoples_jobs_and_running_ones_change_nothing() -> None:
    stage = Stage()
    await stage.play(FIRST_AFTER + LENGTH + 1)
    stage.hear(Trial("stored", "t", job={"id": "j", "state": "queued"}))
    stage.hear(Job("other", "failed"))
    stage.hear(Job("j", "running"))
    await stage.play(2 * PAUSE)
    assert (stage.rehearsals.told, stage.kinds().count("trial.start")) == ("job running", 1)


async def test_a_key_that_may_not_record_is_asked_once() -> None:
    stage = Stage()
    await stage.play(FIRST_AFTER + 1)
    stage.hear(Error("forbidden", "No."))
    await stage.play(2 * LENGTH)
    assert stage.kinds() == ["trial.start", "clip.start"]


async def test_a_lost_recording_is_followed_by_another() -> None:
    stage = Stage()
    await stage.play(FIRST_AFTER + 100)
    stage.rehearsals.lose(stage.seq)
    await stage.play(PAUSE + 1)
    assert stage.kinds().count("trial.start") == 2
