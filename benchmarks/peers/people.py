"""Whose forecasts are asked for: a decoder, a window and a motion for everybody."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32

from app.commands.bench.residents import vary
from models.checkpoint import SHIPPED, Checkpoint, dump_personal, load_checkpoint, load_personal
from models.data.synthetic import SyntheticPerson
from models.personal import PersonalDecoder
from models.predictor import Predictor
from models.rounding import round_matrices
from models.spec import MotionSpec

SPEC = MotionSpec()
MOTION_S = 20.0

Poses = Float32[np.ndarray, "time 20 3"]


@dataclass(frozen=True, slots=True, eq=False)
class Person:
    """One of them.

    Attributes:
        user: id.
        decoder: their own, behind the shared encoder.
        window: the poses from which every request has its forecast made.
        motion: what a stream shows, at 30 Hz; it begins with the window.
        expected: the forecast of that window by their own decoder.
        expected_of_base: that by the base.
    """

    user: str
    decoder: PersonalDecoder
    window: Poses
    motion: Poses
    expected: Poses
    expected_of_base: Poses


def invent_people(count: int, folder: Path) -> list[Person]:
    """Make people, and leave their decoders in files for the servers."""
    checkpoint = load_checkpoint(SHIPPED)
    people = []
    for number, decoder in zip(range(count), vary(checkpoint.predictor.decoder), strict=False):
        user = f"user-{number}"
        round_matrices(decoder)  # as Kinecast keeps versions: everybody serves the same weights
        blob = dump_personal(decoder, {}, base_sha256=checkpoint.sha256)
        (folder / user).write_bytes(blob)
        people.append(_meet(user, load_decoder(checkpoint, folder / user), seed=number))
    return people


def _meet(user: str, decoder: PersonalDecoder, *, seed: int) -> Person:
    times = np.arange(round(MOTION_S * SPEC.rate_hz)) / SPEC.rate_hz
    motion = SyntheticPerson(seed).perform(endless=True).pose_at(times).astype(np.float32)
    window = motion[: SPEC.observe]
    return Person(
        user,
        decoder,
        window,
        motion,
        forecast(decoder, [window])[0],
        forecast(decoder.base, [window])[0],
    )


def load_decoder(checkpoint: Checkpoint, file: Path) -> PersonalDecoder:
    """Read a decoder that `invent_people` left."""
    return load_personal(file.read_bytes(), checkpoint.predictor, base_sha256=checkpoint.sha256)


def forecast(net: PersonalDecoder | Predictor, windows: Sequence[Poses]) -> list[Poses]:
    """Forecast windows by PyTorch, as who serves a net by a framework does."""
    with torch.inference_mode():
        frames = net(torch.from_numpy(np.stack(windows)))
    return list(frames.numpy())


def to_bytes(poses: Poses) -> bytes:
    """Write poses as the servers of the peers take and give them."""
    return poses.astype("<f4").tobytes()


def from_bytes(data: bytes) -> Poses:
    """Read what `to_bytes` wrote."""
    return np.frombuffer(data, "<f4").reshape(-1, SPEC.joints, 3).astype(np.float32)
