import math

import pytest
import torch
from torch.nn import functional

from models.predictor import NetConfig, Predictor, forecast_in_batches
from models.spec import MotionSpec


def test_an_untrained_net_says_zero_velocity(synthetic_windows: torch.Tensor) -> None:
    window = synthetic_windows[:, :15]
    forecast = Predictor().eval()(window)
    assert torch.allclose(forecast, window[:, -1:].expand(-1, 15, -1, -1), atol=1e-6)


@pytest.mark.parametrize("offset", [(10.0, 0.0, 0.0), (-7.0, 2.0, 10.0), (0.0, -10.0, -10.0)])
def test_moving_the_scene_moves_the_forecast_alike(
    predictor: Predictor, synthetic_windows: torch.Tensor, offset: tuple[float, float, float]
) -> None:
    window = synthetic_windows[:, :15].double()
    move = torch.tensor(offset, dtype=torch.float64)
    difference = predictor(window + move).double() - move - predictor(window).double()
    assert difference.abs().max() < 1e-5


def test_turning_the_scene_turns_the_forecast(
    predictor: Predictor, synthetic_windows: torch.Tensor
) -> None:
    window = synthetic_windows[:, :15]
    cos, sin = math.cos(2.0), math.sin(2.0)
    turn = torch.tensor([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
    assert torch.allclose(predictor(window @ turn.T), predictor(window) @ turn.T, atol=1e-4)


@pytest.mark.parametrize("horizon", [1, 15, 40])
def test_any_horizon_can_be_rolled_out(
    predictor: Predictor, synthetic_windows: torch.Tensor, horizon: int
) -> None:
    window = synthetic_windows[:, :15]
    long = predictor(window, horizon=horizon)
    assert long.shape == (16, horizon, 20, 3)
    shared = min(horizon, 15)
    assert torch.allclose(long[:, :shared], predictor(window)[:, :shared], atol=1e-6)


def test_a_forecast_alone_is_the_forecast_in_a_batch(
    predictor: Predictor, synthetic_windows: torch.Tensor
) -> None:
    window = synthetic_windows[:, :15]
    together = predictor(window)
    alone = torch.cat([predictor(w[None]) for w in window])
    assert (together - alone).abs().max() < 1e-4
    assert torch.allclose(forecast_in_batches(predictor, window, batch=5), together, atol=1e-5)


def test_a_window_of_the_wrong_length_is_refused(predictor: Predictor) -> None:
    with pytest.raises(ValueError, match="15 frames of 20 joints"):
        predictor(torch.zeros(1, 14, 20, 3))


@pytest.mark.parametrize(("field", "value"), [("observe", 2), ("horizon", 0), ("rate_hz", 0.0)])
def test_a_spec_that_makes_no_sense_is_refused(field: str, value: float) -> None:
    with pytest.raises(ValueError, match=r"must be"):
        MotionSpec(**{field: value})


def test_a_small_net_overfits_eight_windows(synthetic_windows: torch.Tensor) -> None:
    torch.manual_seed(0)
    windows = synthetic_windows[:8]
    window, future = windows[:, :15], windows[:, 15:]
    net = Predictor(config=NetConfig(encoder_hidden=32, decoder_hidden=64, spl_hidden=16))
    net.normalizer.fit(window)
    optimizer = torch.optim.Adam(net.parameters(), lr=5e-3)
    standing = functional.mse_loss(window[:, -1:].expand_as(future), future)
    for _ in range(150):
        loss = functional.mse_loss(net(window), future)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert loss < standing / 50


def test_each_part_of_the_forecast_path_has_a_say(
    predictor: Predictor, synthetic_windows: torch.Tensor
) -> None:
    window = synthetic_windows[:, :15]
    before = predictor(window)
    for name in FORECAST_PATH:
        changed = Predictor(predictor.spec, predictor.config).eval()
        changed.load_state_dict(predictor.state_dict())
        with torch.no_grad():
            for parameter in changed.get_submodule(name).parameters():
                parameter.zero_()
        assert (changed(window) - before).abs().max() > 1e-6, name


FORECAST_PATH = (
    "encoder.streams.position",
    "encoder.streams.velocity",
    "encoder.streams.acceleration",
    "encoder.attention",
    "latent.to_z",
    "latent.to_c",
    "decoder.attention",
    "decoder.token_z",
    "decoder.token_c",
    "decoder.token_h",
    "decoder.cell",
    "decoder.predict",
)
