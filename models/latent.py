"""The latent: continuous z, categorical c, their priors and discriminators (eq. 5 of the paper).

The adversarial game is that of the adversarial autoencoder (Makhzani et al. 2015): each
discriminator learns to tell draws of a prior from latents of the encoder, and the encoder learns to
fool both, so that z comes to look Gaussian and c like a draw from a uniform categorical.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional


class Latent(nn.Module):
    """z by a linear layer; c by a linear layer and softmax."""

    def __init__(self, features: int, *, continuous: int, categories: int) -> None:
        super().__init__()
        self.to_z = nn.Linear(features, continuous)
        self.to_c = nn.Linear(features, categories)

    def forward(
        self, attended: Float[Tensor, "*batch features"]
    ) -> tuple[Float[Tensor, "*batch continuous"], Float[Tensor, "*batch category"]]:
        """Give (z, c); the entries of c are positive and sum to one."""
        return self.to_z(attended), self.to_c(attended).softmax(dim=-1)


class Discriminator(nn.Module):
    """Probability (as a logit) that a point comes from the prior rather than from the encoder."""

    def __init__(self, features: int, *, hidden: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.utils.parametrizations.spectral_norm(nn.Linear(features, hidden)),
            nn.LeakyReLU(0.2),
            nn.utils.parametrizations.spectral_norm(nn.Linear(hidden, hidden)),
            nn.LeakyReLU(0.2),
            nn.Linear(hidden, 1),
        )

    def forward(self, point: Float[Tensor, "batch features"]) -> Float[Tensor, " batch"]:
        """Logit per point: above 0 means 'from the prior'."""
        logit: Tensor = self.layers(point)
        return logit.squeeze(-1)


def sample_z_prior(like: Float[Tensor, "batch continuous"]) -> Float[Tensor, "batch continuous"]:
    """Draw from N(0, I), as many and on the same device as `like`."""
    return torch.randn_like(like)


def sample_c_prior(
    like: Float[Tensor, "batch category"], *, softness: float = 0.1
) -> Float[Tensor, "batch category"]:
    """Draw one-hot categories uniformly, slightly softened.

    A softmax never reaches a corner, so exact one-hot vectors would be told apart at once; a little
    of the uniform distribution mixed in takes that shortcut away.
    """
    count = like.shape[-1]
    index = torch.randint(count, like.shape[:-1], device=like.device)
    hard = functional.one_hot(index, count).to(like.dtype)
    weight = softness * torch.rand(*like.shape[:-1], 1, device=like.device, dtype=like.dtype)
    return hard * (1 - weight) + weight / count


class Adversary(nn.Module):
    """Both discriminators and the two sides of their game."""

    def __init__(self, *, continuous: int, categories: int, hidden: int) -> None:
        super().__init__()
        self.on_z = Discriminator(continuous, hidden=hidden)
        self.on_c = Discriminator(categories, hidden=hidden)

    def discriminator_loss(
        self, z: Float[Tensor, "batch continuous"], c: Float[Tensor, "batch category"]
    ) -> Float[Tensor, ""]:
        """Tell priors (1) from latents (0); the encoder gets no gradient from this side."""
        loss = torch.zeros((), device=z.device)
        for net, latent, prior in (
            (self.on_z, z.detach(), sample_z_prior(z)),
            (self.on_c, c.detach(), sample_c_prior(c)),
        ):
            loss = loss + functional.softplus(-net(prior)).mean()
            loss = loss + functional.softplus(net(latent)).mean()
        return loss

    def encoder_loss(
        self, z: Float[Tensor, "batch continuous"], c: Float[Tensor, "batch category"]
    ) -> Float[Tensor, ""]:
        """Fool both discriminators: latents should pass for draws of their priors."""
        fooled: Tensor = functional.softplus(-self.on_z(z)).mean()
        return fooled + functional.softplus(-self.on_c(c)).mean()
