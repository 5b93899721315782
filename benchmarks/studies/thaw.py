"""Fine-tune the whole net for a person, encoder and all, to compare the frozen encoder with."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from models.arithmetic import arithmetic
from models.data.augment import augment
from models.data.clips import Clip
from models.data.windows import cut_windows
from models.losses import reconstruction_loss
from models.personal import PersonalDecoder
from models.predictor import Encoded, Predictor
from models.training.config import one_cycle
from models.training.finetune import FinetuneConfig


def thaw(net: Predictor, clips: Sequence[Clip], config: FinetuneConfig) -> Predictor:
    """Fit a copy of the whole net to one person's clips, by the rules of `finetune`.

    Windows are augmented anew in each step, as nothing can be encoded beforehand.
    """
    cut = cut_windows(clips, net.spec)
    whole = torch.cat([torch.as_tensor(cut.observed), torch.as_tensor(cut.future)], dim=1)
    with arithmetic(1), torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        return _descend(net, whole, config)


def _descend(
    net: Predictor, whole: Float[Tensor, "window time joint 3"], config: FinetuneConfig
) -> Predictor:
    fitted = copy.deepcopy(net).train().requires_grad_(requires_grad=True)
    average, observe = copy.deepcopy(net), net.spec.observe
    optimizer = torch.optim.Adam(fitted.parameters(), lr=0.0)
    for step in range(config.steps):
        chosen = whole[torch.randint(len(whole), (config.batch,))]
        windows = augment(chosen, config.augmentation, observe=observe)
        shape = one_cycle(step / config.steps, warm_up=config.warm_up)
        for group in optimizer.param_groups:
            group["lr"] = config.learning_rate * shape
        loss = reconstruction_loss(fitted(windows[:, :observe]), windows[:, observe:])
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(fitted.parameters(), config.clip)
        optimizer.step()
        _approach(average, fitted, 1 - config.average)
    return average.eval().requires_grad_(requires_grad=False)


def blend_nets(base: Predictor, fitted: Predictor, share: float) -> Predictor:
    """Give a net with weights between the base's (0) and the fitted ones (1)."""
    mixed = copy.deepcopy(base)
    _approach(mixed, fitted, share)
    return mixed


@torch.no_grad()
def _approach(net: Predictor, target: Predictor, part: float) -> None:
    for weight, other in zip(net.parameters(), target.parameters(), strict=True):
        weight.lerp_(other, part)


@dataclass(frozen=True, eq=False)
class GatedNet:
    """A whole net of a person's own, gated and corrected as a person's decoder is.

    Attributes:
        rest: the base, and the gate and correction in its latent.
        own: the net.
    """

    rest: PersonalDecoder
    own: Predictor

    def __call__(
        self, window: Float[Tensor, "batch observe joint 3"]
    ) -> Float[Tensor, "batch horizon joint 3"]:
        """Forecast the frames that follow each window."""
        base = self.rest.base
        encoded = base.encode(window)
        of_base, own = _roll(base, encoded), _roll(self.own, self.own.encode(window))
        share = self.rest.share(encoded.z)[:, None, None, None]
        moved = torch.lerp(of_base, self.rest.correct(own, of_base, encoded.z), share)
        return base.normalizer.from_net(moved, window, encoded.placement)


def _roll(net: Predictor, encoded: Encoded) -> Tensor:
    moved: Tensor = net.decoder(encoded.z, encoded.c, encoded.seed, horizon=net.spec.horizon)
    return moved
