"""A teacher of the latent: which action a window shows, and which part of it.

What the encoder knows of an action and of how far it has come is what a person's decoder can use
later. So that z says it, a linear layer that is thrown away after training has to read it there.
Where weights are symmetric it reads the sums of z's halves alone, which mirroring leaves as they
are: an action of the left hand is the same action.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn


class MomentReader(nn.Module):
    """Reads from z which moment of which action a window shows.

    Args:
        continuous: size of z.
        moments: actions times parts of an action.
        symmetric: read nothing but sums of halves.
    """

    def __init__(self, *, continuous: int, moments: int, symmetric: bool) -> None:
        super().__init__()
        self.symmetric = symmetric
        self.read = nn.Linear(continuous // 2 if symmetric else continuous, moments)

    def loss(
        self, z: Float[Tensor, "batch continuous"], moments: Float[Tensor, "batch moment"]
    ) -> Float[Tensor, ""]:
        """Cross-entropy with the moments; a window without one costs nothing, but counts.

        A blend of two windows has shares of two moments.
        """
        seen = z.unflatten(1, (2, -1)).sum(1) if self.symmetric else z
        told: Tensor = (moments * self.read(seen).log_softmax(-1)).sum(-1)
        return -torch.mean(told)
