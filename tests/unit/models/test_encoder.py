import pytest
import torch

from models.encoder import STREAMS, Encoder, TokenAttention, differences


@pytest.fixture
def encoder() -> Encoder:
    torch.manual_seed(0)
    return Encoder(20, hidden=16, heads=4).eval()


def streams(position: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    return (position, *differences(position, torch.ones(3)))


def test_the_encoder_is_causal(encoder: Encoder) -> None:
    position = torch.randn(3, 15, 20, 3)
    changed = position.clone()
    changed[:, 9:] += 1.0
    before, after = (encoder.run_streams(*streams(p)) for p in (position, changed))
    assert torch.equal(before[:, :9], after[:, :9])
    assert not torch.allclose(before[:, 9:], after[:, 9:])


def test_every_stream_has_a_recurrence_of_its_own(encoder: Encoder) -> None:
    position = torch.randn(2, 15, 20, 3)
    inputs = list(streams(position))
    before = encoder.run_streams(*inputs)
    for index, name in enumerate(STREAMS):
        changed = list(inputs)
        changed[index] = changed[index] + 1.0
        moved = (encoder.run_streams(*changed) - before).abs().amax(dim=(0, 1, 3))
        assert moved[index] > 1e-3, name
        assert moved[[i for i in range(3) if i != index]].max() == 0


def test_attention_mixes_the_streams(encoder: Encoder) -> None:
    hidden = torch.randn(2, 3, 16)
    changed = hidden.clone()
    changed[:, 2] += 1.0
    moved = (encoder.attend(hidden) - encoder.attend(changed)).view(2, 3, 16).abs().amax(dim=2)
    assert (moved > 1e-4).all()


def test_attention_agrees_with_the_library() -> None:
    torch.manual_seed(0)
    own = TokenAttention(16, heads=4).eval()
    library = torch.nn.MultiheadAttention(16, 4, batch_first=True).eval()
    with torch.no_grad():
        library.in_proj_weight.copy_(own.project.weight)
        library.in_proj_bias.copy_(own.project.bias)
        library.out_proj.load_state_dict(own.mix.state_dict())
    tokens = torch.randn(5, 3, 16)
    expected = own.norm(tokens + library(tokens, tokens, tokens)[0])
    assert torch.allclose(own(tokens), expected, atol=1e-5)


def test_heads_must_divide_the_width() -> None:
    with pytest.raises(ValueError, match="not a multiple"):
        TokenAttention(10, heads=4)


def test_differences_are_velocity_and_acceleration() -> None:
    time = torch.arange(15.0)
    position = (0.5 * time**2)[None, :, None, None].expand(1, 15, 20, 3)
    velocity, acceleration = differences(position, torch.tensor([1.0, 2.0, 4.0]))
    assert torch.allclose(velocity[0, 1:, 0, 0], (time[:-1] + 0.5) / 2.0)
    assert torch.allclose(acceleration[0, 2:, 0, 0], torch.full((13,), 0.25))
    assert velocity[:, 0].abs().max() == 0
    assert acceleration[:, :2].abs().max() == 0
