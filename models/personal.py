"""One person's decoder as it is served: behind the shared encoder, gated by familiarity.

As far as a window is familiar, the forecast is the person's: the fitted decoder's for the most
part, and for the rest that of the base, corrected by what it was seen to get wrong nearby. The
remainder is the base's.
"""

from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from models.correction import Correction
from models.decoder import Decoder
from models.familiarity import Familiarity
from models.predictor import Encoded, Predictor


@dataclass(frozen=True, slots=True, weakref_slot=True)
class PersonalDecoder:
    """One person's decoder behind the shared encoder; called like every forecaster.

    Attributes:
        base: the net that it belongs to; its encoder is shared, and its decoder answers as far as
            a window is unfamiliar.
        decoder: the person's, in evaluation mode.
        familiarity: what the person's windows look like; None: everything is familiar.
        metadata: what the file says about itself.
        correction: of the base near the windows of `familiarity`; None: the decoder answers alone.
    """

    base: Predictor
    decoder: Decoder
    familiarity: Familiarity | None
    metadata: dict[str, Any]
    correction: Correction | None = None

    def __post_init__(self) -> None:
        """Refuse a correction without the windows that it stands on."""
        if self.correction is not None and self.familiarity is None:
            raise ValueError("a correction needs a model of familiarity to stand on")

    def __call__(
        self, window: Float[Tensor, "batch observe joint 3"]
    ) -> Float[Tensor, "batch horizon joint 3"]:
        """Forecast the frames that follow each window: metres, in the frame of the input."""
        return self.forecast(self.base.encode(window), window)[0]

    def forecast(
        self, encoded: Encoded, window: Float[Tensor, "batch observe joint 3"]
    ) -> tuple[Float[Tensor, "batch horizon joint 3"], Float[Tensor, " batch"]]:
        """Forecast windows that were encoded before.

        Returns:
            The forecast in metres, in the frame of the input; and the person's share of each, the
            rest of which is the base's. A decoder without any share is not run.
        """
        share = self.share(encoded.z)
        moved = self._mix(encoded, share)
        return self.base.normalizer.from_net(moved, window, encoded.placement), share

    def share(self, z: Float[Tensor, "batch continuous"]) -> Float[Tensor, " batch"]:
        """Tell which part of each forecast is the person's, 0 to 1."""
        if self.familiarity is None:
            return z.new_ones(len(z))
        return self.familiarity.share(z)

    def reaching(self, half: float) -> "PersonalDecoder":
        """Give the same with a gate that lets it answer nearer to, or further from, its trials."""
        if self.familiarity is None:
            return self
        return replace(self, familiarity=self.familiarity.reaching(half))

    def correct(
        self,
        own: Float[Tensor, "batch horizon joint 3"],
        of_base: Float[Tensor, "batch horizon joint 3"],
        z: Float[Tensor, "batch continuous"],
    ) -> Float[Tensor, "batch horizon joint 3"]:
        """Give the corrected base its part in what the decoder says (normalised units)."""
        if self.correction is None or self.familiarity is None:
            return own
        corrected = of_base + self.correction(self.familiarity.measure(z)).view_as(of_base)
        return torch.lerp(own, corrected, self.correction.part)

    def _mix(self, encoded: Encoded, share: Float[Tensor, " batch"]) -> Tensor:
        if bool((share == 1).all()) and self.correction is None:
            return self._roll(self.decoder, encoded)
        of_base = self._roll(self.base.decoder, encoded)
        if bool((share == 0).all()):
            return of_base
        own = self.correct(self._roll(self.decoder, encoded), of_base, encoded.z)
        return torch.lerp(of_base, own, share[:, None, None, None])

    def _roll(self, decoder: Decoder, encoded: Encoded) -> Tensor:
        moved: Tensor = decoder(encoded.z, encoded.c, encoded.seed, horizon=self.base.spec.horizon)
        return moved
