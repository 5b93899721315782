"""One person's decoder as a service holds it: laid out for the kernel, without torch's copy."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from models.personal import PersonalDecoder
from models.predictor import Predictor
from models.runtime.fused import FusedForecast, PackedPerson, find_packed, forecast_fused
from models.runtime.pack import PackedBase, pack_correction, pack_decoder, pack_gate


@dataclass(frozen=True, slots=True, weakref_slot=True, eq=False)
class ServedDecoder:
    """One person's decoder behind the shared encoder; called like every forecaster.

    Attributes:
        base: the net that it belongs to.
        packed_base: that net, as the kernel reads it.
        person: the decoder, its gate and its correction, as the kernel reads them.
        metadata: what the file says about itself.
    """

    base: Predictor
    packed_base: PackedBase
    person: PackedPerson
    metadata: dict[str, Any]

    def __call__(
        self, window: Float[Tensor, "batch observe joint 3"]
    ) -> Float[Tensor, "batch horizon joint 3"]:
        """Forecast the frames that follow each window: metres, in the frame of the input."""
        made = forecast_served(self.packed_base, window.numpy(), [self] * len(window))
        return window[:, -1:] + torch.from_numpy(made.displacement)


def serve(personal: PersonalDecoder) -> PersonalDecoder | ServedDecoder:
    """Lay a decoder out for the kernel; where there is none, it stays as it is."""
    base = find_packed(personal.base)
    if base is None:
        return personal
    gate, correction = personal.familiarity, personal.correction
    person = PackedPerson(
        pack_decoder(personal.decoder),
        None if gate is None else pack_gate(gate),
        None if correction is None else pack_correction(correction),
    )
    return ServedDecoder(personal.base, base, person, personal.metadata)


def forecast_served(
    base: PackedBase,
    windows: Float[np.ndarray, "batch observe joint 3"],
    decoders: Sequence[ServedDecoder | None],
) -> FusedForecast:
    """Forecast each window by its own version, all of which run behind one encoder.

    Args:
        base: the shared net.
        windows: metres, y up.
        decoders: for each row whose decoder it is for; None for the base.
    """
    return forecast_fused(base, windows, [None if one is None else one.person for one in decoders])
