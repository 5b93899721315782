"""Nets and objectives with a part taken away, everything else as it is shipped.

A part is exchanged in an otherwise ordinary net, so that `models` knows nothing of it. Files of
such nets are of a format of their own, which no service and no command can load.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor, nn

from models.encoder import Encoder
from models.latent import Latent
from models.losses import distance_loss
from models.predictor import NetConfig, Predictor
from models.symmetry import Symmetry, halves
from models.training.config import PretrainConfig
from models.training.loop import Trainer

FORMAT = "kinecast-ablated-1"


class DeafEncoder(Encoder):
    """An encoder that is told nothing in one of its streams."""

    def __init__(self, size: NetConfig, joints: int, *, silent: str) -> None:
        super().__init__(
            joints, hidden=size.encoder_hidden, heads=size.encoder_heads, dropout=size.dropout
        )
        self.silent = silent

    def run_streams(
        self,
        position: Float[Tensor, "batch time joint 3"],
        velocity: Float[Tensor, "batch time joint 3"],
        acceleration: Float[Tensor, "batch time joint 3"],
    ) -> Float[Tensor, "batch time stream hidden"]:
        """Run the streams, one of them on zeros."""
        if self.silent == "velocity":
            velocity = torch.zeros_like(velocity)
        else:
            acceleration = torch.zeros_like(acceleration)
        return super().run_streams(position, velocity, acceleration)


class NoAttention(nn.Module):
    """What is left of an attention layer without its attention: the norm."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)

    def forward(
        self, tokens: Float[Tensor, "batch token width"]
    ) -> Float[Tensor, "batch token width"]:
        """Normalise each token by itself."""
        normal: Tensor = self.norm(tokens)
        return normal


class SilentCategories(Latent):
    """A latent whose categories are always equally probable."""

    def forward(
        self, attended: Float[Tensor, "*batch features"]
    ) -> tuple[Float[Tensor, "*batch continuous"], Float[Tensor, "*batch category"]]:
        """Give (z, c) with a c that says nothing."""
        z, c = super().forward(attended)
        return z, torch.full_like(c, 1 / c.shape[-1])


class PlainHead(nn.Module):
    """One MLP for the whole pose, in the place of the structured prediction layer."""

    def __init__(self, *, features: int, joints: int, hidden: int) -> None:
        super().__init__()
        self.joints = joints
        self.inner = nn.Linear(features, hidden)
        self.outer = nn.Linear(hidden, joints * 3)
        nn.init.zeros_(self.outer.weight)
        nn.init.zeros_(self.outer.bias)

    def forward(self, state: Float[Tensor, "batch features"]) -> Float[Tensor, "batch joint 3"]:
        """One pose from the decoder's state."""
        pose: Tensor = self.outer(torch.relu(self.inner(state)))
        return pose.view(len(state), self.joints, 3)


class PlainSymmetry(Symmetry):
    """How mirroring acts on a net with a plain head."""

    def __init__(self, net: Predictor) -> None:
        super().__init__(net)
        head = net.decoder.predict
        assert isinstance(head, PlainHead)
        inner = halves(len(head.inner.bias))
        self.swaps |= {
            "decoder.predict.inner.weight": (inner, halves(net.config.decoder_hidden)),
            "decoder.predict.inner.bias": (inner,),
            "decoder.predict.outer.weight": (self.pose, inner),
            "decoder.predict.outer.bias": (self.pose,),
        }


def silence(net: Predictor, *, stream: str) -> None:
    """Tell the encoder nothing in one stream."""
    net.encoder = DeafEncoder(net.config, net.spec.joints, silent=stream)


def drop_encoder_attention(net: Predictor) -> None:
    """Take the attention over the streams away."""
    net.encoder.attention = NoAttention(net.config.encoder_hidden)  # type: ignore[assignment]


def drop_decoder_attention(net: Predictor) -> None:
    """Take the attention over (z, c, state) away."""
    net.decoder.attention = NoAttention(net.config.decoder_token)  # type: ignore[assignment]


def drop_categories(net: Predictor) -> None:
    """Let c say nothing."""
    size = net.config
    net.latent = SilentCategories(
        net.encoder.width, continuous=size.continuous, categories=size.categories
    )


def flatten_head(net: Predictor) -> None:
    """Predict the whole pose at once instead of joint by joint along the tree."""
    features, coordinates = net.config.decoder_hidden, 3 * net.spec.joints
    weights = sum(weight.numel() for weight in net.decoder.predict.parameters())
    hidden = round((weights - coordinates) / (features + 1 + coordinates) / 2) * 2
    head = PlainHead(features=features, joints=net.spec.joints, hidden=hidden)
    net.decoder.predict = head  # type: ignore[assignment]


PARTS: dict[str, Callable[[Predictor], None]] = {
    "velocity": partial(silence, stream="velocity"),
    "acceleration": partial(silence, stream="acceleration"),
    "encoder-attention": drop_encoder_attention,
    "decoder-attention": drop_decoder_attention,
    "c": drop_categories,
    "spl": flatten_head,
}
"""Parts of the net that can be taken away."""
SQUARED_LOSS = "squared-loss"


def ablate(net: Predictor, part: str) -> Predictor:
    """Take a part away from a fresh net."""
    if part in PARTS:
        PARTS[part](net)
    return net


def make_trainer(part: str) -> type[Trainer]:
    """Give a trainer of nets and objectives without a part; "" takes nothing away."""

    class AblatedTrainer(Trainer):
        def make_net(self) -> Predictor:
            return ablate(super().make_net(), part)

        def make_symmetry(self) -> Symmetry:
            return PlainSymmetry(self.net) if part == "spl" else super().make_symmetry()

        def measure(self, forecast: Tensor, future: Tensor) -> Tensor:
            if part == SQUARED_LOSS:
                return distance_loss(forecast, future)
            return super().measure(forecast, future)

    return AblatedTrainer if part else Trainer


def without_augmentation(config: PretrainConfig, *names: str) -> PretrainConfig:
    """Switch augmentations off."""
    return replace(config, augmentation=replace(config.augmentation, **dict.fromkeys(names, 0.0)))
