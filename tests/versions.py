"""Personal versions in a database without training: a small net and decoders that differ."""

import copy
import hashlib
from typing import Any

import numpy as np
import torch
from torch import Tensor

from app.domain.versions import Verdict, Version
from app.live.decoders import Decoders
from app.storage import users, versions
from app.storage.database import Database
from models.baselines import Forecaster
from models.checkpoint import PersonalDecoder, dump_personal
from models.decoder import Decoder
from models.familiarity import Familiarity, FamiliarityRule
from models.predictor import Predictor
from tests.nets import TINY
from tests.personal_support import add_trial, claim, enqueue, finish

BASE_SHA256 = hashlib.sha256(b"the base of these tests").hexdigest()


def make_net() -> Predictor:
    torch.manual_seed(5)
    return Predictor(config=TINY).eval().requires_grad_(requires_grad=False)


def make_personal(
    base: Predictor,
    seed: int,
    *,
    scale: float = 0.02,
    familiarity: Familiarity | None = None,
    **metadata: Any,
) -> PersonalDecoder:
    """A decoder that a little noise makes somebody's own."""
    decoder: Decoder = copy.deepcopy(base.decoder)
    noise = torch.Generator().manual_seed(seed)
    for weight in decoder.parameters():
        weight.data += scale * torch.randn(weight.shape, generator=noise)
    return PersonalDecoder(base, decoder, familiarity, metadata)


def dump(personal: PersonalDecoder, *, base_sha256: str = BASE_SHA256) -> bytes:
    return dump_personal(
        personal.decoder,
        personal.metadata,
        base_sha256=base_sha256,
        familiarity=personal.familiarity,
        correction=personal.correction,
    )


def know(
    base: Predictor, windows: np.ndarray, *, half: float = 0.75, width: float = 0.08
) -> Familiarity:
    """A model of the windows that a person was recorded in."""
    with torch.inference_mode():
        z = base.encode(centre(windows)).z.clone()
    return Familiarity.fit(z, FamiliarityRule(half, width))


def centre(windows: np.ndarray) -> Tensor:
    """Windows as the net is given them, the last hip centre at the origin."""
    return torch.from_numpy((windows - windows[:, -1:, 3:4]).astype(np.float32))


def make_net_decoders(base: Predictor) -> Decoders:
    return Decoders(base, base_sha256=BASE_SHA256)


def forecast_offline(forecaster: Forecaster, observed: np.ndarray) -> np.ndarray:
    """What a version makes of 15 poses, computed without the service: metres."""
    origin = observed[-1:, 3:4]
    window = torch.from_numpy((observed - origin).astype(np.float32))[None]
    with torch.inference_mode():
        return forecaster(window)[0].numpy() + origin


async def add_version(
    database: Database,
    user_id: str,
    personal: PersonalDecoder,
    *,
    wins: bool = True,
    base_sha256: str = BASE_SHA256,
) -> Version:
    """Store a version as a job does; one that wins is active at once."""
    async with database.write() as tx:
        user = await users.get(tx, user_id)
        await add_trial(tx, user)
        await enqueue(tx, user)
    held = await claim(database, base_sha256=base_sha256)
    async with database.read() as tx:
        parent = (await versions.read_active_of(tx, user.uuid)).number
    verdict = Verdict.PROMOTE if wins else Verdict.REJECT
    await finish(
        database,
        held,
        blob=dump(personal, base_sha256=base_sha256),
        parent=parent,
        verdict=verdict,
        base_sha256=base_sha256,
    )
    async with database.read() as tx:
        return (await versions.list_all(tx, user.uuid))[-1]
