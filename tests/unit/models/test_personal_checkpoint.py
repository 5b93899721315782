import copy
import json

import pytest
import torch
from safetensors.torch import save

from models.baselines import ZeroVelocity
from models.checkpoint import CheckpointError, dump_checkpoint, dump_personal, load_personal
from models.predictor import Predictor

BASE = "ab" * 32


def test_a_decoder_forecasts_behind_the_encoder_of_its_base(
    predictor: Predictor, synthetic_windows: torch.Tensor
) -> None:
    window = synthetic_windows[:, :15]
    whole = copy.deepcopy(predictor).eval()
    for weight in whole.decoder.parameters():
        weight.data += 0.01
    blob = dump_personal(whole.decoder, {"data": "d"}, base_sha256=BASE)
    assert blob == dump_personal(whole.decoder, {"data": "d"}, base_sha256=BASE)
    loaded = load_personal(blob, predictor, base_sha256=BASE)
    assert loaded.metadata["data"] == "d"
    assert torch.allclose(loaded(window), whole(window), atol=1e-6)
    assert not torch.allclose(loaded(window), predictor(window), atol=1e-4)


def test_what_is_no_decoder_of_this_base_is_refused(predictor: Predictor) -> None:
    blob = dump_personal(predictor.decoder, {}, base_sha256=BASE)
    empty = {"kinecast": json.dumps({"format": "kinecast-personal-1", "base_sha256": BASE})}
    broken = copy.deepcopy(predictor.decoder)
    next(iter(broken.parameters())).data.fill_(float("nan"))
    for wrong, base, sha256, words in (
        (b"rotten", predictor, BASE, "not a Kinecast checkpoint"),
        (dump_checkpoint(predictor, {}), predictor, BASE, "format"),
        (blob, predictor, "cd" * 32, "fitted on the base"),
        (blob, ZeroVelocity(15), BASE, "no decoder"),
        (dump_personal(broken, {}, base_sha256=BASE), predictor, BASE, "not finite"),
        (save({"decoder.x": torch.zeros(1)}, metadata=empty), predictor, BASE, "do not fit"),
        (save({}, metadata={"kinecast": "[1]"}), predictor, BASE, "not a Kinecast checkpoint"),
    ):
        with pytest.raises(CheckpointError, match=words):
            load_personal(wrong, base, base_sha256=sha256)
