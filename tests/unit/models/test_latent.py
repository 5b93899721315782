import torch

from models.latent import Adversary, Latent, sample_c_prior, sample_z_prior


def test_c_is_a_distribution_over_categories() -> None:
    z, c = Latent(12, continuous=6, categories=5)(torch.randn(7, 12))
    assert z.shape == (7, 6)
    assert torch.allclose(c.sum(-1), torch.ones(7))
    assert (c > 0).all()


def test_priors_are_gaussian_and_uniform() -> None:
    torch.manual_seed(0)
    z = sample_z_prior(torch.zeros(20_000, 3))
    c = sample_c_prior(torch.zeros(20_000, 4))
    assert z.mean(0).abs().max() < 0.03
    assert (z.std(0) - 1).abs().max() < 0.03
    assert torch.allclose(c.sum(-1), torch.ones(20_000))
    assert (c.argmax(-1).bincount() / 20_000 - 0.25).abs().max() < 0.02
    assert (c.max(-1).values > 0.9).all()


def test_discriminators_learn_to_tell_a_prior_from_a_latent() -> None:
    torch.manual_seed(0)
    adversary = Adversary(continuous=4, categories=5, hidden=32)
    optimizer = torch.optim.Adam(adversary.parameters(), lr=5e-3)

    def draw() -> tuple[torch.Tensor, torch.Tensor]:
        return 0.3 * torch.randn(128, 4) + 1.0, torch.full((128, 5), 0.2)

    for _ in range(150):
        optimizer.zero_grad()
        adversary.discriminator_loss(*draw()).backward()
        optimizer.step()
    z, c = draw()
    right = [
        (adversary.on_z(sample_z_prior(z)) > 0).float().mean(),
        (adversary.on_z(z) < 0).float().mean(),
        (adversary.on_c(sample_c_prior(c)) > 0).float().mean(),
        (adversary.on_c(c) < 0).float().mean(),
    ]
    assert min(right) > 0.85


def test_the_encoder_learns_to_fool_them() -> None:
    torch.manual_seed(0)
    adversary = Adversary(continuous=4, categories=5, hidden=32)
    discriminators = torch.optim.Adam(adversary.parameters(), lr=5e-3)
    shift = torch.full((4,), 3.0, requires_grad=True)
    encoder = torch.optim.Adam([shift], lr=5e-2)
    c = torch.full((256, 5), 0.2)
    for _ in range(300):
        z = torch.randn(256, 4) + shift
        discriminators.zero_grad()
        adversary.discriminator_loss(z, c).backward()
        discriminators.step()
        encoder.zero_grad()
        adversary.encoder_loss(z, c).backward()
        encoder.step()
    assert shift.detach().norm() < 0.5 * 6.0  # it began at 3 in each of 4 directions


def test_the_discriminators_side_leaves_the_encoder_alone() -> None:
    adversary = Adversary(continuous=4, categories=5, hidden=8)
    z = torch.randn(6, 4, requires_grad=True)
    c = torch.randn(6, 5, requires_grad=True)
    adversary.discriminator_loss(z, c.softmax(-1)).backward()
    assert z.grad is None
    assert c.grad is None
