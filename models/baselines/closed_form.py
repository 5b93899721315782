"""The base corrected by what it gets wrong on a person, and nothing else; see `correction.py`.

A row of the tables that a fitted decoder must be better than.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from models.correction import STRENGTH, WIDTH, Correction
from models.data.clips import Clip
from models.familiarity import Familiarity
from models.predictor import Encoded, Predictor
from models.training.finetune import learn_nearby


@dataclass(frozen=True, eq=False)
class KernelCorrection:
    """A base whose errors on one person are known; called like every forecaster.

    Attributes:
        base: the net.
        familiarity: of the person's windows.
        correction: of the base near them.
    """

    base: Predictor
    familiarity: Familiarity
    correction: Correction

    @classmethod
    def fit(
        cls,
        base: Predictor,
        clips: Sequence[Clip],
        *,
        width: float = WIDTH,
        strength: float = STRENGTH,
    ) -> "KernelCorrection":
        """Solve for a person's clips.

        Args:
            base: the net whose errors these are.
            clips: of one person.
            width: of the bumps, in the distance of familiarity.
            strength: of the regularisation towards the base.

        Raises:
            ValueError: no clip is as long as a window.
        """
        return cls(base, *learn_nearby(base, clips, width=width, strength=strength))

    def __call__(
        self, window: Float[Tensor, "batch observe joint 3"]
    ) -> Float[Tensor, "batch horizon joint 3"]:
        """Forecast the frames that follow each window: metres, in the frame of the input."""
        encoded = self.base.encode(window)
        moved = self._roll(encoded)
        moved = moved + self.correction(self.familiarity.measure(encoded.z)).view_as(moved)
        return self.base.normalizer.from_net(moved, window, encoded.placement)

    def _roll(self, encoded: Encoded) -> Tensor:
        horizon = self.base.spec.horizon
        moved: Tensor = self.base.decoder(encoded.z, encoded.c, encoded.seed, horizon=horizon)
        return moved
