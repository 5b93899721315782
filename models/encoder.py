"""The encoder: three recurrent streams and self-attention over them (the paper's eq. 3 and 4)."""

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

STREAMS = ("position", "velocity", "acceleration")


class TokenAttention(nn.Module):
    """Multi-head self-attention over a handful of tokens, with residual and layer norm.

    Vaswani et al. 2017. Used over the three streams here, and over (z, c, hidden) in the decoder.
    """

    def __init__(self, width: int, *, heads: int) -> None:
        super().__init__()
        if width % heads:
            raise ValueError(f"width {width} is not a multiple of {heads} heads")
        self.heads = heads
        self.project = nn.Linear(width, 3 * width)
        self.mix = nn.Linear(width, width)
        self.norm = nn.LayerNorm(width)

    def forward(
        self, tokens: Float[Tensor, "batch token width"]
    ) -> Float[Tensor, "batch token width"]:
        """Let each token look at all tokens of its own sample; shapes are kept."""
        batch, count, width = tokens.shape
        split = self.project(tokens).view(batch, count, 3, self.heads, width // self.heads)
        query, key, value = split.unbind(2)  # each: batch token head width/heads
        # Products and sums, not matmul: for three tokens they are several times as fast.
        scores = (query[:, :, None] * key[:, None]).sum(-1) / math.sqrt(width // self.heads)
        weights = scores.softmax(dim=2)  # batch token seen head
        attended = (weights[..., None] * value[:, None]).sum(2).reshape(batch, count, width)
        mixed: Tensor = self.norm(tokens + self.mix(attended))
        return mixed


class Encoder(nn.Module):
    """Summarise an observed window, causally, frame by frame.

    Each stream (positions, their first and their second differences) has a unidirectional GRU of
    its own; at each frame, self-attention over the three hidden states lets them weigh each other.
    """

    def __init__(self, joints: int, *, hidden: int, heads: int, dropout: float = 0.0) -> None:
        super().__init__()
        self.joints = joints
        self.hidden = hidden
        self.streams = nn.ModuleDict(
            {name: nn.GRU(joints * 3, hidden, batch_first=True) for name in STREAMS}
        )
        self.dropout = nn.Dropout(dropout)
        self.attention = TokenAttention(hidden, heads=heads)

    @property
    def width(self) -> int:
        """Numbers per frame in the output."""
        return self.hidden * len(STREAMS)

    def forward(
        self,
        position: Float[Tensor, "batch time joint 3"],
        velocity: Float[Tensor, "batch time joint 3"],
        acceleration: Float[Tensor, "batch time joint 3"],
    ) -> Float[Tensor, "batch features"]:
        """Give h_att of the last frame, which summarises the window (normalised units)."""
        return self.attend(self.run_streams(position, velocity, acceleration)[:, -1])

    def run_streams(
        self,
        position: Float[Tensor, "batch time joint 3"],
        velocity: Float[Tensor, "batch time joint 3"],
        acceleration: Float[Tensor, "batch time joint 3"],
    ) -> Float[Tensor, "batch time stream hidden"]:
        """Hidden state of each stream at each frame; frame t depends on frames 1..t alone."""
        inputs = dict(zip(STREAMS, (position, velocity, acceleration), strict=True))
        hidden = [self.streams[name](x.flatten(2))[0] for name, x in inputs.items()]
        return torch.stack(hidden, dim=2)

    def attend(
        self, hidden: Float[Tensor, "batch stream hidden"]
    ) -> Float[Tensor, "batch features"]:
        """Self-attention over the streams of one frame."""
        attended: Tensor = self.attention(self.dropout(hidden))
        return attended.flatten(1)


def differences(
    position: Float[Tensor, "batch time joint 3"], scales: Float[Tensor, "3"]
) -> tuple[Float[Tensor, "batch time joint 3"], Float[Tensor, "batch time joint 3"]]:
    """First and second differences of the positions, as long as these, standardised.

    The frames before the window are taken as resting in its first frame, so the first velocity and
    the first two accelerations carry no information from outside of the window.
    """
    padded = torch.cat([position[:, :1], position[:, :1], position], dim=1)
    velocity = padded.diff(dim=1)
    acceleration = velocity.diff(dim=1)
    acceleration[:, 1] = 0.0  # the start of the window is no jerk
    return velocity[:, 1:] / scales[1], acceleration / scales[2]
