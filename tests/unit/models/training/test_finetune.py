import copy

import pytest
import torch

from models.data.clips import Clip
from models.predictor import Predictor
from models.training.finetune import (
    FinetuneConfig,
    FinetuneProgress,
    blend,
    encode_clips,
    encode_windows,
    finetune,
)

QUICK = FinetuneConfig(steps=30, batch=16, copies=2)


def test_only_the_decoder_learns_and_the_base_stays_as_it_is(
    predictor: Predictor, clips: list[Clip]
) -> None:
    before = copy.deepcopy(predictor.state_dict())
    decoder = finetune(predictor, clips, QUICK)
    assert all(torch.equal(before[name], t) for name, t in predictor.state_dict().items())
    changed = [
        not torch.equal(new, old)
        for new, old in zip(decoder.parameters(), predictor.decoder.parameters(), strict=True)
    ]
    assert sum(changed) > len(changed) / 2
    assert not any(weight.requires_grad for weight in decoder.parameters())


def test_the_error_on_the_persons_own_windows_falls(
    predictor: Predictor, synthetic_windows: torch.Tensor, clips: list[Clip]
) -> None:
    decoder = finetune(predictor, clips, FinetuneConfig(steps=120, batch=32, copies=2))
    encoded = encode_windows(predictor, synthetic_windows[:8])

    @torch.no_grad()
    def error(candidate: torch.nn.Module) -> float:
        moved = candidate(encoded.z, encoded.c, encoded.seed, horizon=15)
        moved = moved * predictor.normalizer.scales[0]
        return float((moved - encoded.target).square().mean())

    assert error(decoder) < 0.8 * error(predictor.decoder)


def test_equal_clips_and_settings_give_equal_weights(
    predictor: Predictor, clips: list[Clip]
) -> None:
    torch.manual_seed(1)
    first = finetune(predictor, clips, QUICK)
    torch.manual_seed(2)  # the caller's random numbers are nobody's business
    second = finetune(predictor, clips, QUICK)
    for one, other in zip(first.parameters(), second.parameters(), strict=True):
        assert torch.equal(one, other)


def test_parts_of_the_decoder_learn_at_their_own_rates(
    predictor: Predictor, clips: list[Clip]
) -> None:
    config = FinetuneConfig(steps=10, batch=16, copies=1, rates={"cell": 0.0, "predict": 0.5})
    decoder = finetune(predictor, clips, config)
    pairs = zip(decoder.named_parameters(), predictor.decoder.parameters(), strict=True)
    moved = {name: not torch.equal(new, old) for (name, new), old in pairs}
    assert not any(moved[name] for name in moved if name.startswith("cell"))
    assert any(moved[name] for name in moved if name.startswith("predict"))


def test_progress_is_told_and_may_stop_the_fit(predictor: Predictor, clips: list[Clip]) -> None:
    told: list[FinetuneProgress] = []

    def report(progress: FinetuneProgress) -> None:
        told.append(progress)
        if len(told) == 5:
            raise InterruptedError

    with pytest.raises(InterruptedError):
        finetune(predictor, clips, QUICK, report=report)
    assert [progress.step for progress in told] == [1, 2, 3, 4, 5]
    assert all(progress.steps == QUICK.steps and progress.loss > 0 for progress in told)


def test_however_much_was_recorded_what_is_held_stays_bounded(
    predictor: Predictor, clips: list[Clip]
) -> None:
    def count(most: int) -> int:
        config = FinetuneConfig(copies=3, most=most)
        with torch.random.fork_rng(devices=[]):
            return len(encode_clips(predictor, clips, config))

    whole = count(10**6)
    assert whole % 3 == 0
    assert count(whole - 1) == whole // 3 * 2
    assert count(whole // 3) == whole // 3
    assert 5 < count(10) <= 10


def test_a_blend_lies_between_base_and_fit(predictor: Predictor, clips: list[Clip]) -> None:
    fitted = finetune(predictor, clips, QUICK)
    none, half, whole = (blend(predictor.decoder, fitted, share) for share in (0.0, 0.5, 1.0))
    for a, b, c, base, fit in zip(
        *(net.parameters() for net in (none, half, whole, predictor.decoder, fitted)), strict=True
    ):
        assert torch.equal(a, base)
        assert torch.allclose(c, fit)
        assert torch.allclose(b, (base + fit) / 2, atol=1e-6)


def test_a_clip_shorter_than_a_window_is_refused(predictor: Predictor, clips: list[Clip]) -> None:
    short = [Clip(clips[0].poses[:20], "1", "a", "1", "kinecast")]
    with pytest.raises(ValueError, match="window"):
        finetune(predictor, short, QUICK)
