from dataclasses import fields, replace
from pathlib import Path

import pytest
import torch

from models.data.augment import Augmentation
from models.data.clips import Clip
from models.predictor import Predictor
from models.training.config import PretrainConfig
from models.training.loop import Progress, Trainer, train
from models.training.sampler import WindowSampler

CPU = torch.device("cpu")


def make_trainer(config: PretrainConfig, clips: list[Clip]) -> Trainer:
    sampler = WindowSampler(
        clips,
        length=30,
        batch=config.batch,
        shares=config.shares,
        pools=(),
        tempo=0.1,
        slow=0.1,
        device=CPU,
    )
    return Trainer(config, sampler, device=CPU)


def run(trainer: Trainer, state: Path | None = None, **hooks: object) -> Predictor:
    report = hooks.get("report", lambda _: None)
    validate = hooks.get("validate", lambda _: None)
    return train(trainer, validate=validate, report=report, state=state)


def same(one: Predictor, other: Predictor) -> bool:
    a, b = one.state_dict(), other.state_dict()
    return all(torch.equal(a[name], b[name]) for name in a)


class KilledError(Exception):
    """The process ended in the middle of a run."""


def test_two_steps_saved_and_two_more_equal_four(
    config: PretrainConfig, clips: list[Clip], tmp_path: Path
) -> None:
    whole = run(make_trainer(config, clips))
    state = tmp_path / "run.state"

    def die(now: Progress) -> None:
        if now.step == 3:
            raise KilledError

    with pytest.raises(KilledError):
        run(make_trainer(config, clips), state, report=die)
    assert state.exists()
    torch.manual_seed(12345)  # whatever happened to the global generator in between
    assert same(run(make_trainer(config, clips), state), whole)


def test_another_seed_gives_another_net(config: PretrainConfig, clips: list[Clip]) -> None:
    one, other = (run(make_trainer(replace(config, seed=s), clips)) for s in (0, 1))
    assert not same(one, other)


def test_a_state_of_other_settings_is_refused(
    config: PretrainConfig, clips: list[Clip], tmp_path: Path
) -> None:
    state = tmp_path / "run.state"
    make_trainer(config, clips).save(state, {"best": None, "since": 0})
    with pytest.raises(ValueError, match="other settings"):
        make_trainer(replace(config, seed=3), clips).restore(state)


def test_training_lowers_the_loss(config: PretrainConfig, clips: list[Clip]) -> None:
    losses: list[float] = []
    plain = Augmentation(**{field.name: 0.0 for field in fields(Augmentation)})
    longer = replace(config, steps=140, learning_rate=2e-2, augmentation=plain)
    run(make_trainer(longer, clips), report=lambda now: losses.append(now.loss))
    assert sum(losses[-10:]) < 0.8 * sum(losses[:10])


def test_patience_ends_a_run_that_no_longer_gains(
    config: PretrainConfig, clips: list[Clip]
) -> None:
    seen: list[Progress] = []
    scores = iter([5.0, 4.0, 4.5, 4.6, 4.7, 4.8])
    patient = replace(config, steps=12, patience=1)
    run(make_trainer(patient, clips), report=seen.append, validate=lambda _: next(scores))
    assert seen[-1].step == 8  # best at 4; worse at 6 and at 8


def test_the_adversary_plays_only_after_the_reconstruction_has_settled(
    config: PretrainConfig, clips: list[Clip]
) -> None:
    seen: list[Progress] = []
    run(make_trainer(config, clips), report=seen.append)
    assert [now.adversary > 0 for now in seen] == [False, False, True, True]


def test_without_its_weight_the_adversary_never_plays(
    config: PretrainConfig, clips: list[Clip]
) -> None:
    seen: list[Progress] = []
    trainer = make_trainer(replace(config, adversarial_weight=0.0), clips)
    before = [p.clone() for p in trainer.adversary.parameters()]
    run(trainer, report=seen.append)
    assert all(now.adversary == 0 for now in seen)
    assert all(map(torch.equal, before, trainer.adversary.parameters()))
