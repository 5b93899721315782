from pathlib import Path

import pytest
import torch

from models.checkpoint import load_checkpoint
from models.data.clips import Clip
from models.training.config import PretrainConfig
from models.training.pretrain import pretrain, write_pretrained


def test_pretraining_ends_in_a_checkpoint_that_says_where_it_comes_from(
    config: PretrainConfig, clips: list[Clip], tmp_path: Path
) -> None:
    result = pretrain(clips, config, leave_out=[("utd-mhad", "1")])
    assert result.scores is not None
    path = tmp_path / "base.safetensors"
    sha256 = write_pretrained(path, result, command="kinecast pretrain --data somewhere")
    loaded = load_checkpoint(path)
    assert loaded.sha256 == sha256
    assert loaded.metadata["command"] == "kinecast pretrain --data somewhere"
    assert loaded.metadata["left_out"] == ["utd-mhad/1"]
    assert loaded.metadata["data"]["utd-mhad"]["subjects"] == ["0", "2"]
    assert len(loaded.metadata["data_sha256"]) == 64
    assert loaded.metadata["pretraining"]["adversarial_weight"] > 0
    assert loaded.metadata["parameters"]["decoder"] > 0


def test_people_left_out_do_not_reach_the_weights(
    config: PretrainConfig, clips: list[Clip]
) -> None:
    one = pretrain(clips, config, leave_out=[("utd-mhad", "1")])
    other = pretrain([c for c in clips if c.subject != "1"], config)
    pairs = zip(
        one.predictor.state_dict().values(), other.predictor.state_dict().values(), strict=True
    )
    assert all(torch.equal(a, b) for a, b in pairs)
    assert other.scores is None


def test_training_leaves_the_callers_random_numbers_alone(
    config: PretrainConfig, clips: list[Clip]
) -> None:
    torch.manual_seed(7)
    expected = torch.rand(3)
    torch.manual_seed(7)
    pretrain(clips, config)
    assert torch.equal(torch.rand(3), expected)


def test_somebody_who_is_not_in_the_data_cannot_be_left_out(
    config: PretrainConfig, clips: list[Clip]
) -> None:
    with pytest.raises(ValueError, match="no clips of"):
        pretrain(clips, config, leave_out=[("utd-mhad", "99")])
