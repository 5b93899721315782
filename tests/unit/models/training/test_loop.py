from dataclasses import fields, replace
from pathlib import Path

import pytest
import torch

from models.data.augment import Augmentation, mirror
from models.data.clips import Clip
from models.losses import label_loss
from models.predictor import Predictor
from models.symmetry import Symmetry
from models.training.config import PretrainConfig
from models.training.loop import Progress, Trainer, train
from models.training.sampler import WindowSampler, list_actions

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
        labels=list_actions(clips, config.label_source),
        moments=config.moments,
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
    longer = replace(
        longer, symmetric=False, label_weight=0.0
    )  # four units have few symmetric ones
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


def test_the_categories_learn_the_actions(config: PretrainConfig, clips: list[Clip]) -> None:
    plain = Augmentation(**{field.name: 0.0 for field in fields(Augmentation)})
    longer = replace(config, steps=100, learning_rate=2e-2, augmentation=plain)
    longer = replace(longer, adversarial_weight=0.0)
    found = []
    for weight in (0.0, 1.0):
        trainer = make_trainer(replace(longer, label_weight=weight), clips)
        net = run(trainer)
        [drawn] = trainer.sampler.draw()
        with torch.no_grad():
            c = net.encode(drawn.windows[:, :15]).c
        actions = drawn.labels.unflatten(1, (-1, trainer.sampler.moments)).sum(2)
        found.append(float(label_loss(c, actions)))
    assert found[1] < 0.5 * found[0]


@pytest.mark.parametrize("symmetric", [False, True])
def test_the_latent_learns_the_moments(
    config: PretrainConfig, clips: list[Clip], symmetric: bool
) -> None:
    plain = Augmentation(**{field.name: 0.0 for field in fields(Augmentation)})
    longer = replace(config, steps=100, learning_rate=2e-2, augmentation=plain)
    longer = replace(longer, adversarial_weight=0.0, moment_weight=1.0, symmetric=symmetric)
    trainer = make_trainer(longer, clips)
    assert trainer.reader is not None
    [drawn] = trainer.sampler.draw()

    def measure() -> float:
        with torch.no_grad():
            z = trainer.net.encode(drawn.windows[:, :15]).z
            return float(trainer.reader.loss(z, drawn.labels))

    before = measure()
    run(trainer)
    assert measure() < 0.7 * before


def test_mirrored_windows_show_the_same_moment(config: PretrainConfig, clips: list[Clip]) -> None:
    trainer = make_trainer(config, clips)
    assert trainer.reader is not None
    assert trainer.symmetry is not None
    trainer.net.eval()
    [drawn] = trainer.sampler.draw()
    with torch.no_grad():
        losses = [
            float(trainer.reader.loss(trainer.net.encode(windows[:, :15]).z, drawn.labels))
            for windows in (drawn.windows, mirror(drawn.windows))
        ]
    assert losses[0] == pytest.approx(losses[1], abs=1e-4)


def test_without_actions_or_weight_nobody_reads_moments(
    config: PretrainConfig, clips: list[Clip]
) -> None:
    assert make_trainer(replace(config, moment_weight=0.0), clips).reader is None
    elsewhere = make_trainer(replace(config, label_source="elsewhere"), clips)
    assert elsewhere.reader is None
    elsewhere.run_step()


def test_more_actions_than_categories_are_refused(
    config: PretrainConfig, clips: list[Clip]
) -> None:
    few = replace(config, net=replace(config.net, categories=1))
    with pytest.raises(ValueError, match="do not fit into 1 categories"):
        make_trainer(few, clips)


@pytest.mark.parametrize("symmetric", [True, False])
def test_a_symmetric_net_stays_symmetric_to_the_last_bit(
    config: PretrainConfig, clips: list[Clip], *, symmetric: bool
) -> None:
    net = run(make_trainer(replace(config, symmetric=symmetric), clips))
    before = {name: weight.clone() for name, weight in net.state_dict().items()}
    Symmetry(net).impose(net)
    kept = [torch.equal(before[name], weight) for name, weight in net.state_dict().items()]
    assert all(kept) == symmetric
