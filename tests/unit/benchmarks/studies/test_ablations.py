from dataclasses import replace

import pytest
import torch

from benchmarks.studies.ablations import PARTS, ablate, make_trainer, without_augmentation
from benchmarks.studies.recordings import read_person
from benchmarks.studies.thaw import GatedNet, blend_nets, thaw
from models.familiarity import Familiarity
from models.personal import PersonalDecoder
from models.predictor import Predictor
from models.training.config import PretrainConfig
from models.training.finetune import FinetuneConfig
from models.training.loop import Trainer
from tests.nets import SMALL


@pytest.fixture
def net():
    torch.manual_seed(0)
    made = Predictor(config=SMALL)
    torch.nn.init.normal_(made.decoder.predict.to_offset)
    return made.eval()


def make_windows(count=4):
    torch.manual_seed(1)
    return torch.randn(count, 15, 20, 3)


@pytest.mark.parametrize("stream", ["velocity", "acceleration"])
def test_a_silenced_stream_says_nothing(net, stream):
    ablate(net, stream)
    position, velocity, acceleration = (torch.randn(2, 15, 20, 3) for _ in range(3))
    before = net.encoder(position, velocity, acceleration)
    told = {"velocity": velocity, "acceleration": acceleration}
    told[stream] = torch.randn(2, 15, 20, 3)
    assert torch.equal(net.encoder(position, **told), before)
    other = next(name for name in told if name != stream)
    told[other] = torch.randn(2, 15, 20, 3)
    assert not torch.equal(net.encoder(position, **told), before)


def test_without_c_every_window_has_the_same(net):
    c = ablate(net, "c").encode(make_windows()).c
    assert torch.equal(c, torch.full_like(c, 1 / SMALL.categories))


def test_without_attention_tokens_do_not_see_each_other(net):
    for attention in (
        ablate(net, "encoder-attention").encoder.attention,
        ablate(net, "decoder-attention").decoder.attention,
    ):
        width = attention.norm.normalized_shape[0]
        tokens = torch.randn(2, 3, width)
        other = tokens.clone()
        other[:, 1] = torch.randn(2, width)
        assert torch.equal(attention(tokens)[:, 0], attention(other)[:, 0])


def test_a_plain_head_is_of_like_size_and_starts_with_zero_velocity():
    whole = Predictor()
    plain = ablate(Predictor(), "spl")
    sizes = [sum(p.numel() for p in one.decoder.parameters()) for one in (whole, plain)]
    assert sizes[1] == pytest.approx(sizes[0], rel=0.01)
    windows = make_windows()
    assert torch.allclose(plain(windows), windows[:, -1:].expand(-1, 15, -1, -1), atol=1e-5)


def test_each_part_changes_the_net_and_nothing_else_does(net):
    windows = make_windows()
    before = net(windows)
    assert torch.equal(ablate(net, "")(windows), before)
    for part in PARTS:
        torch.manual_seed(0)
        made = ablate(Predictor(config=SMALL), part)
        assert made(windows).shape == before.shape


def test_nothing_taken_away_is_the_trainer_itself():
    assert make_trainer("") is Trainer
    assert issubclass(make_trainer("c"), Trainer)


def test_augmentations_are_switched_off_by_name():
    config = PretrainConfig()
    off = without_augmentation(config, "tempo", "slow")
    assert off == replace(config, augmentation=replace(config.augmentation, tempo=0.0, slow=0.0))


def test_the_whole_net_is_fitted_and_blended(net, place):
    trial = read_person(place, "utd-mhad/2", "1")
    config = FinetuneConfig(steps=3, batch=8)
    before = {name: weight.clone() for name, weight in net.named_parameters()}
    fitted, again = thaw(net, trial, config), thaw(net, trial, config)
    moved = {
        name.split(".")[0]
        for name, weight in fitted.named_parameters()
        if not torch.equal(weight, before[name])
    }
    assert moved == {"encoder", "latent", "decoder"}
    assert all(torch.equal(weight, before[name]) for name, weight in net.named_parameters())
    for one, other in zip(fitted.parameters(), again.parameters(), strict=True):
        assert torch.equal(one, other)
    windows = make_windows()
    assert torch.allclose(blend_nets(net, fitted, 1.0)(windows), fitted(windows), atol=1e-5)
    gate = Familiarity.fit(net.encode(windows).z + 1e6)
    gated = GatedNet(PersonalDecoder(net, net.decoder, gate, {}), fitted)
    assert torch.equal(gated(windows), net(windows))
