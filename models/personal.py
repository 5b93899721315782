"""One person's decoder as it is served: behind the shared encoder, gated by familiarity."""

from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

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
    """

    base: Predictor
    decoder: Decoder
    familiarity: Familiarity | None
    metadata: dict[str, Any]

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

    def _mix(self, encoded: Encoded, share: Float[Tensor, " batch"]) -> Tensor:
        if bool((share == 1).all()):
            return self._roll(self.decoder, encoded)
        if bool((share == 0).all()):
            return self._roll(self.base.decoder, encoded)
        of_base = self._roll(self.base.decoder, encoded)
        return torch.lerp(of_base, self._roll(self.decoder, encoded), share[:, None, None, None])

    def _roll(self, decoder: Decoder, encoded: Encoded) -> Tensor:
        moved: Tensor = decoder(encoded.z, encoded.c, encoded.seed, horizon=self.base.spec.horizon)
        return moved
