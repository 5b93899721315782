"""Windows of many people in one batch: encoded once, then each decoder on the rows that need it."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from models.decoder import Decoder
from models.personal import PersonalDecoder
from models.predictor import Encoded, Predictor
from models.skeleton import HIP_CENTER

NET_FAILURES = (
    RuntimeError,
    ValueError,
    TypeError,
    ArithmeticError,
    LookupError,
    AttributeError,
    AssertionError,
    MemoryError,
)
"""What a net, or the library under it, can raise."""


@dataclass(frozen=True, slots=True)
class MixedForecast:
    """What a batch of several people gave.

    Attributes:
        frames: metres, in the frame of the input.
        share: the part of each row's version, 0 for the base; NaN where it cannot tell.
        failures: what a personal decoder raised, by row; such a row of `frames` means nothing.
    """

    frames: Float[Tensor, "batch horizon joint 3"]
    share: Float[Tensor, " batch"]
    failures: dict[int, Exception] = field(default_factory=dict)


def centre(
    windows: Float[np.ndarray, "batch observe 20 3"],
) -> Float[Tensor, "batch observe 20 3"]:
    """Put each person's last hip centre at the origin, in float64, before it becomes float32.

    So the place of the person in the room costs no precision.
    """
    centred = windows - windows[:, -1:, HIP_CENTER : HIP_CENTER + 1]
    return torch.from_numpy(centred.astype(np.float32))


def forecast_mixed(
    base: Predictor,
    window: Float[Tensor, "batch observe joint 3"],
    personal: Sequence[PersonalDecoder | None],
) -> MixedForecast:
    """Forecast each window by its own version, all of which run behind the encoder of `base`.

    A row equals what its `PersonalDecoder`, or the base, makes of it alone. The base's decoder runs
    once, on the rows that are not wholly personal or have a correction to stand on it; a personal
    one only where it has a share. One that raises harms no other row.

    Args:
        base: the shared net.
        window: metres, y up.
        personal: for each row whose decoder it is for; None for the base.

    Raises:
        Exception: what `base` raises, which concerns every row.
    """
    encoded = base.encode(window)
    groups = _group(personal)
    share, failures = _weigh(groups, encoded)
    moved = _run_base(base, encoded, (share < 1) | _find_corrected(personal))
    for decoder, rows in groups:
        mine = [row for row in rows if row not in failures and float(share[row]) != 0]
        if not mine:
            continue
        try:
            part = _pick(encoded, mine)
            own = _roll(decoder.decoder, part, base.spec.horizon)
            own = decoder.correct(own, moved[mine], part.z)
        except NET_FAILURES as error:
            failures |= dict.fromkeys(mine, error)
        else:
            moved[mine] = torch.lerp(moved[mine], own, share[mine, None, None, None])
    return MixedForecast(
        base.normalizer.from_net(moved, window, encoded.placement), share, failures
    )


def _group(
    personal: Sequence[PersonalDecoder | None],
) -> list[tuple[PersonalDecoder, list[int]]]:
    groups: dict[int, tuple[PersonalDecoder, list[int]]] = {}
    for row, decoder in enumerate(personal):
        if decoder is not None:
            groups.setdefault(id(decoder), (decoder, []))[1].append(row)
    return list(groups.values())


def _weigh(
    groups: list[tuple[PersonalDecoder, list[int]]], encoded: Encoded
) -> tuple[Tensor, dict[int, Exception]]:
    """Tell each row's personal share."""
    share = encoded.z.new_zeros(len(encoded.z))
    failures: dict[int, Exception] = {}
    for decoder, rows in groups:
        try:
            share[rows] = decoder.share(encoded.z[rows])
        except NET_FAILURES as error:
            failures |= dict.fromkeys(rows, error)
    return share, failures


def _find_corrected(personal: Sequence[PersonalDecoder | None]) -> Bool[Tensor, " batch"]:
    """Tell whose forecasts rest on the base's, however familiar a window is."""
    return torch.tensor([one is not None and one.correction is not None for one in personal])


def _run_base(base: Predictor, encoded: Encoded, needed: Tensor) -> Tensor:
    """Roll the base's decoder out where it is needed; the other rows are 0."""
    if bool(needed.all()):
        return _roll(base.decoder, encoded, base.spec.horizon)
    moved = encoded.z.new_zeros(len(needed), base.spec.horizon, base.spec.joints, 3)
    rows = [int(row) for row in needed.nonzero()]
    if rows:
        moved[rows] = _roll(base.decoder, _pick(encoded, rows), base.spec.horizon)
    return moved


def _pick(encoded: Encoded, rows: list[int]) -> Encoded:
    if len(rows) == len(encoded.z):
        return encoded
    return Encoded(encoded.z[rows], encoded.c[rows], encoded.seed[rows], encoded.placement)


def _roll(decoder: Decoder, encoded: Encoded, horizon: int) -> Tensor:
    moved: Tensor = decoder(encoded.z, encoded.c, encoded.seed, horizon=horizon)
    return moved
