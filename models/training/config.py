"""Settings of pretraining: frozen, written into every checkpoint."""

from dataclasses import dataclass, field
from math import cos, pi

from models.data.augment import Augmentation
from models.predictor import NetConfig


@dataclass(frozen=True, slots=True)
class PretrainConfig:
    """Everything that decides what phase 1 gives; equal settings and data give equal weights.

    Attributes:
        net: sizes of the net.
        augmentation: see `Augmentation`.
        steps: optimisation steps; chosen by leaving training subjects out, see LOG.md.
        batch: windows in a step.
        learning_rate: peak of the one-cycle schedule.
        warm_up: share of the steps in which the rate rises.
        weight_decay: AdamW's.
        clip: largest norm of the gradient.
        average: decay of the exponential moving average of the weights, which is what is kept.
        symmetric: keep the weights symmetric, so that mirrored people get mirrored forecasts.
        label_weight: weight of the cross-entropy between the categorical latent and the actions.
        label_source: the source whose actions the categories are taught; others have no labels.
        moment_weight: weight of the cross-entropy between z and the moments of these actions, see
            `moments`.
        moments: parts of an action that are told apart.
        adversarial_weight: weight of the encoder's side of the min-max game; 0 switches it off.
        adversarial_start: share of the steps before the game begins, so that the reconstruction has
            settled; the weight then rises linearly over as many steps again.
        adversary_rate: learning rate of the discriminators.
        adversary_hidden: their width.
        shares: part of each batch by source; sources of the data that are not named share the rest.
        pools: sources whose people may be blended with each other, see `Augmentation.mix`.
        seed: of the initial weights, the sampling and the augmentation.
        evaluate_every: steps between validations on the people left out.
        patience: validations without improvement before stopping early; None runs all steps.
    """

    net: NetConfig = field(default_factory=NetConfig)
    augmentation: Augmentation = field(default_factory=Augmentation)
    steps: int = 3_500
    batch: int = 128
    learning_rate: float = 2e-3
    warm_up: float = 0.15
    weight_decay: float = 5e-2
    clip: float = 1.0
    average: float = 0.998
    symmetric: bool = True
    label_weight: float = 0.02
    label_source: str = "utd-mhad"
    moment_weight: float = 0.02
    moments: int = 5
    adversarial_weight: float = 1e-3
    adversarial_start: float = 0.1
    adversary_rate: float = 5e-4
    adversary_hidden: int = 64
    shares: dict[str, float] = field(default_factory=lambda: {"utd-mhad": 0.45, "precog": 0.15})
    pools: tuple[tuple[str, ...], ...] = (("utd-mhad", "precog"),)
    seed: int = 0
    evaluate_every: int = 500
    patience: int | None = None

    def __post_init__(self) -> None:
        """Refuse settings that contradict each other."""
        if self.steps < 1 or self.batch < 1 or self.evaluate_every < 1:
            raise ValueError("steps, batch and evaluate_every must be positive")
        if sum(self.shares.values()) > 1 + 1e-9:
            raise ValueError(f"shares of a batch add up to more than 1: {self.shares}")

    def rate_at(self, step: int) -> float:
        """One-cycle learning rate: up by a cosine, down by a cosine to nearly zero."""
        return self.learning_rate * one_cycle(step / self.steps, warm_up=self.warm_up)

    def adversarial_weight_at(self, step: int) -> float:
        """Weight of the adversarial loss at a step."""
        ramp = self.adversarial_start * self.steps
        if ramp <= 0:
            return self.adversarial_weight
        return self.adversarial_weight * min(max(step / ramp - 1, 0.0), 1.0)


def one_cycle(progress: float, *, warm_up: float, floor: float = 1e-4) -> float:
    """Shape of the one-cycle schedule (Smith and Topin 2018) at a progress between 0 and 1."""
    if progress < warm_up:
        return 0.04 + 0.96 * (1 - cos(pi * progress / warm_up)) / 2
    down = (progress - warm_up) / (1 - warm_up)
    return floor + (1 - floor) * (1 + cos(pi * min(down, 1.0))) / 2
