"""Synthetic people: their trials, and the window that forecasts are asked for."""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass

import msgspec
import numpy as np
from jaxtyping import Float32

from app.commands.client.errors import ApiError, SilenceError, UnreachableError
from app.commands.client.rest import Api
from models.data.synthetic import SyntheticPerson

ACTIONS = ("wave", "walk", "punch", "reach", "squat")
"""As many clips as there must be for a judgement."""
SECONDS = 1.5
RATE_HZ = 30.0
OBSERVE = 15
AGAIN_S = 0.3


@dataclass(frozen=True, eq=False)
class Upload:
    """One trial as it is sent: the token makes sending it again harmless."""

    user: str
    token: str
    clips: tuple[Float32[np.ndarray, "time joint 3"], ...]
    content: bytes


@dataclass(frozen=True, slots=True)
class Accepted:
    """A trial for which the service answered 202: from then on it must never be lost."""

    upload: Upload
    trial: str
    job: str
    tries: int


def make_upload(user: str, *, seed: int, take: int) -> Upload:
    """Record one take of every action."""
    person = SyntheticPerson(seed)
    clips = tuple(person.record(action, SECONDS, take=take) for action in ACTIONS)
    written = [
        {
            "frames": {"shape": list(clip.shape), "dtype": "<f4", "data": clip.tobytes()},
            "action": action,
        }
        for action, clip in zip(ACTIONS, clips, strict=True)
    ]
    content = msgspec.msgpack.encode({"label": f"take {take}", "clips": written})
    return Upload(user, f"{user}-{take}", clips, content)


def make_window(seed: int) -> Float32[np.ndarray, "15 20 3"]:
    """Give what the person is seen doing whenever a single forecast is asked for."""
    return SyntheticPerson(seed).record("wave", 1.0, take=7)[-OBSERVE:]


async def send_until_accepted(
    api: Api, upload: Upload, *, patience_s: float, note: Callable[[str], None]
) -> Accepted:
    """Send a trial until it is accepted, as a client does that wants to keep it.

    Raises:
        TimeoutError: it was never accepted.
    """
    async with asyncio.timeout(patience_s):
        tries = 1
        while True:
            try:
                answer = await api.add_trial(
                    upload.user,
                    upload.content,
                    media_type="application/msgpack",
                    token=upload.token,
                )
            except (ApiError, SilenceError, UnreachableError) as error:
                note(error.code if isinstance(error, ApiError) else type(error).__name__)
                tries += 1
                await asyncio.sleep(AGAIN_S)
                continue
            return Accepted(upload, answer["trial"]["id"], answer["job"]["id"], tries)
