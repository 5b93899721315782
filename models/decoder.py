"""The decoder: attention, GRU cell and SPL, rolled out over any horizon (eq. 6 of the paper).

This is the part that is kept per person, so it stays small. It is always fed its own output, in
training as in use, so there is no gap between the two.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from models.encoder import TokenAttention
from models.structured_prediction import StructuredPrediction


class Decoder(nn.Module):
    """Roll a pose forward from the latent.

    Args:
        parents: the kinematic tree.
        continuous: size of z.
        categories: size of c.
        token: width of the attended tokens.
        hidden: size of the GRU's state.
        spl_hidden: width of each joint's MLP.
        heads: attention heads.
    """

    def __init__(
        self,
        parents: tuple[int, ...],
        *,
        continuous: int,
        categories: int,
        token: int,
        hidden: int,
        spl_hidden: int,
        heads: int,
        dropout: float = 0.0,
    ) -> None:
        super().__init__()
        self.token_z = nn.Linear(continuous, token)
        self.token_c = nn.Linear(categories, token)
        self.token_h = nn.Linear(hidden, token)
        self.start = nn.Linear(continuous + categories, hidden)
        self.attention = TokenAttention(token, heads=heads)
        self.cell = nn.GRUCell(len(parents) * 3 + 3 * token, hidden)
        self.dropout = nn.Dropout(dropout)
        self.predict = StructuredPrediction(parents, features=hidden, hidden=spl_hidden)

    def forward(
        self,
        z: Float[Tensor, "batch continuous"],
        c: Float[Tensor, "batch category"],
        seed: Float[Tensor, "batch joint 3"],
        *,
        horizon: int,
    ) -> Float[Tensor, "batch horizon joint 3"]:
        """Displacements from the seed pose, frame by frame (normalised units).

        `seed` is the last observed pose. Each step predicts where every joint will be relative to
        it, so a step's error does not add to the error of the step before.
        """
        hidden = torch.tanh(self.start(torch.cat([z, c], dim=-1)))
        token_z, token_c = self.token_z(z), self.token_c(c)
        displacement = torch.zeros_like(seed)
        frames = []
        for _ in range(horizon):
            tokens = torch.stack([token_z, token_c, self.token_h(hidden)], dim=1)
            context = self.attention(tokens).flatten(1)
            pose = (seed + displacement).flatten(1)
            hidden = self.cell(torch.cat([pose, context], dim=-1), hidden)
            displacement = self.predict(self.dropout(hidden))
            frames.append(displacement)
        return torch.stack(frames, dim=1)
