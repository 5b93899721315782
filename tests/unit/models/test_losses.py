import torch

from models.losses import reconstruction_loss


def test_a_perfect_forecast_costs_nothing() -> None:
    truth = torch.randn(2, 15, 20, 3)
    assert reconstruction_loss(truth, truth) == 0


def test_a_constant_offset_costs_its_length_and_its_square() -> None:
    truth = torch.zeros(2, 15, 20, 3)
    moved = truth + torch.tensor([0.03, 0.0, 0.04])
    expected = 0.05 + 20 * 0.05**2 / 3
    assert torch.allclose(reconstruction_loss(moved, truth), torch.tensor(expected), atol=1e-6)


def test_an_early_mistake_costs_more_than_the_same_later() -> None:
    truth = torch.zeros(1, 15, 20, 3)
    costs = []
    for frame in (2, 7, 12):
        wrong = truth.clone()
        wrong[:, frame] = 0.1
        costs.append(float(reconstruction_loss(wrong, truth)))
    assert costs == sorted(costs, reverse=True)
    assert costs[0] > costs[2] * 1.05
