import torch

from models.losses import label_loss, reconstruction_loss


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


def test_categories_that_name_the_action_cost_least() -> None:
    labels = torch.tensor([[1.0, 0.0], [0.0, 0.0]])
    right, wrong = torch.tensor([[1.0, 0.0, 0.0]] * 2), torch.tensor([[0.0, 0.5, 0.5]] * 2)
    unsure = torch.tensor([[1 / 3, 1 / 3, 1 / 3]] * 2)
    costs = [float(label_loss(c, labels)) for c in (right, unsure, wrong)]
    assert abs(costs[0]) < 1e-5
    assert costs == sorted(costs)
    assert torch.allclose(label_loss(unsure, labels), torch.tensor(3.0).log() / 2, atol=1e-4)


def test_windows_without_a_label_cost_nothing() -> None:
    assert label_loss(torch.full((4, 3), 1 / 3), torch.zeros(4, 2)) == 0
    assert label_loss(torch.full((4, 3), 1 / 3), torch.zeros(4, 0)) == 0
