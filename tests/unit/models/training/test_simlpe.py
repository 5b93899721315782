from dataclasses import replace
from pathlib import Path

import pytest
import torch

from models.baselines import ZeroVelocity
from models.baselines.simlpe import Simlpe, SimlpeSizes
from models.checkpoint import CheckpointError, dump_checkpoint
from models.data.augment import Augmentation
from models.data.clips import Clip
from models.data.windows import cut_windows
from models.predictor import Predictor
from models.spec import MotionSpec
from models.training.bootstrap import clip_errors
from models.training.config import PretrainConfig
from models.training.loop import Progress
from models.training.simlpe import (
    SimlpeConfig,
    SimlpeFinetune,
    personalize_simlpe,
    train_simlpe,
)
from models.training.simlpe_file import load_simlpe, save_simlpe
from tests.nets import SMALL

CALM = Augmentation(mirror=0.0, scale=0.0, bones=0.0, still=0.0, slow=0.0, flicker=0.0, mix=0.0)
SHORT = SimlpeConfig(sizes=SimlpeSizes(layers=2), steps=3, batch=8, evaluate_every=2)


def is_same(one: Simlpe, other: Simlpe) -> bool:
    pairs = zip(one.state_dict().values(), other.state_dict().values(), strict=True)
    return all(torch.equal(a, b) for a, b in pairs)


def error_of(net: Simlpe, clips: list[Clip]) -> float:
    return clip_errors(net, cut_windows(clips, MotionSpec())).mse_cm2[-1]


def test_it_is_trained_by_the_rules_of_the_base() -> None:
    peer, ours = SimlpeConfig(), PretrainConfig()
    for name in ("shares", "pools", "warm_up", "average", "clip"):
        assert getattr(peer, name) == getattr(ours, name), name


def test_training_is_repeatable_and_leaves_the_callers_random_numbers_alone(
    clips: list[Clip],
) -> None:
    torch.manual_seed(7)
    expected = torch.rand(3)
    torch.manual_seed(7)
    first = train_simlpe(clips, SHORT)
    assert torch.equal(torch.rand(3), expected)
    assert is_same(first.net, train_simlpe(clips, SHORT).net)
    assert not is_same(first.net, train_simlpe(clips, replace(SHORT, seed=1)).net)


def test_people_left_out_are_validated_on_and_do_not_reach_the_weights(clips: list[Clip]) -> None:
    seen: list[Progress] = []
    one = train_simlpe(clips, SHORT, leave_out=[("utd-mhad", "1")], report=seen.append)
    other = train_simlpe([clip for clip in clips if clip.subject != "1"], SHORT)
    assert is_same(one.net, other.net)
    assert [(now.step, now.validation is not None) for now in seen] == [
        (1, False),
        (2, True),
        (3, False),
    ]
    assert one.scores is not None
    assert other.scores is None
    assert one.metadata["left_out"] == ["utd-mhad/1"]
    with pytest.raises(ValueError, match="no clips of"):
        train_simlpe(clips, SHORT, leave_out=[("utd-mhad", "99")])


def test_it_learns_and_a_person_improves_it(clips: list[Clip]) -> None:
    config = replace(SHORT, steps=120, batch=32, learning_rate=1e-2, augmentation=CALM, average=0.9)
    others, own = ([c for c in clips if (c.subject == "2") is mine] for mine in (False, True))
    net = train_simlpe(others, config).net
    still = clip_errors(ZeroVelocity(), cut_windows(others, MotionSpec())).mse_cm2[-1]
    assert error_of(net, others) < 0.5 * still
    before = {name: tensor.clone() for name, tensor in net.state_dict().items()}
    recipe = SimlpeFinetune(steps=60, learning_rate=5e-3, augmentation=CALM)
    personal = personalize_simlpe(net, own, recipe)
    assert error_of(personal, own) < 0.8 * error_of(net, own)
    assert all(torch.equal(before[name], tensor) for name, tensor in net.state_dict().items())
    assert is_same(personal, personalize_simlpe(net, own, recipe))


def test_a_file_gives_back_the_net_and_where_it_comes_from(
    clips: list[Clip], tmp_path: Path
) -> None:
    trained = train_simlpe(clips, SHORT)
    path = tmp_path / "simlpe.safetensors"
    sha256 = save_simlpe(path, trained.net, trained.metadata | {"command": "this one"})
    loaded = load_simlpe(path)
    assert is_same(loaded.net, trained.net)
    assert loaded.sha256 == sha256
    assert loaded.metadata["command"] == "this one"
    assert loaded.metadata["training"]["steps"] == 3
    assert loaded.metadata["config"] == {"layers": 2, "canonical_heading": False}


def test_other_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"no safetensors")
    with pytest.raises(CheckpointError, match="not a Kinecast checkpoint"):
        load_simlpe(path)
    path.write_bytes(dump_checkpoint(Predictor(config=SMALL), {}))
    with pytest.raises(CheckpointError, match="is not 'kinecast-simlpe-1'"):
        load_simlpe(path)
    net = Simlpe(sizes=SimlpeSizes(layers=1))
    for wrong in ({"layers": 2, "canonical_heading": True}, {"depth": 1}, {"layers": "many"}):
        save_simlpe(path, net, {"config": wrong})
        with pytest.raises(CheckpointError, match="no peer of this version"):
            load_simlpe(path)
