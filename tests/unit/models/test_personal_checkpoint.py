import copy
import json

import pytest
import torch
from safetensors.torch import save

from models.baselines import ZeroVelocity
from models.checkpoint import (
    PERSONAL_FORMAT,
    UNCORRECTED_FORMAT,
    CheckpointError,
    dump_checkpoint,
    dump_personal,
    load_personal,
    parse_blob,
)
from models.correction import Correction
from models.familiarity import Familiarity
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


@pytest.fixture
def corrected(predictor: Predictor) -> bytes:
    """A version with all of its parts."""
    z = torch.randn(9, predictor.config.continuous, generator=torch.manual_seed(0))
    gate = Familiarity.fit(z)
    missed = torch.ones(9, 3 * predictor.spec.horizon * predictor.spec.joints)
    correction = Correction.fit(gate, z, missed)
    return dump_personal(
        predictor.decoder, {}, base_sha256=BASE, familiarity=gate, correction=correction
    )


def rewrite(blob: bytes, **changes: object) -> bytes:
    """Change metadata; a name of a tensor with None takes the tensor away."""
    metadata, tensors = parse_blob(blob)
    for name, value in changes.items():
        place = name.replace("__", ".")
        if place in tensors:
            del tensors[place]
        else:
            metadata[place] = value
    return save(tensors, metadata={"kinecast": json.dumps(metadata)})


def test_a_correction_comes_back_with_the_version(predictor: Predictor, corrected: bytes) -> None:
    loaded = load_personal(corrected, predictor, base_sha256=BASE)
    assert loaded.metadata["format"] == PERSONAL_FORMAT
    assert loaded.correction is not None
    assert loaded.familiarity is not None
    assert len(loaded.correction.coefficients) == len(loaded.familiarity.points)


def test_versions_without_a_correction_are_still_read(predictor: Predictor) -> None:
    blob = dump_personal(predictor.decoder, {}, base_sha256=BASE)
    older = load_personal(rewrite(blob, format=UNCORRECTED_FORMAT), predictor, base_sha256=BASE)
    assert older.correction is None


@pytest.mark.parametrize(
    "changes",
    [
        {"correction__basis": None},
        {"correction": {"width": -1.0, "part": 0.4}},
        {"correction": {"width": 1.0, "strange": 0.4}},
        {"correction": 3},
        {"familiarity__points": None},
    ],
)
def test_damaged_corrections_are_refused(
    predictor: Predictor, corrected: bytes, changes: dict[str, object]
) -> None:
    with pytest.raises(CheckpointError, match=r"correction|familiarity"):
        load_personal(rewrite(corrected, **changes), predictor, base_sha256=BASE)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float8_e4m3fn, torch.int8])
def test_weights_that_no_version_has_are_refused(
    predictor: Predictor, corrected: bytes, dtype: torch.dtype
) -> None:
    metadata, tensors = parse_blob(corrected)
    name = next(iter(tensors))
    strange = tensors | {name: torch.ones(tensors[name].shape).to(dtype)}
    blob = save(strange, metadata={"kinecast": json.dumps(metadata)})
    with pytest.raises(CheckpointError, match="of a kind that no version has"):
        load_personal(blob, predictor, base_sha256=BASE)


def test_a_correction_without_its_windows_is_refused(
    predictor: Predictor, corrected: bytes
) -> None:
    metadata, tensors = parse_blob(corrected)
    del metadata["familiarity"]
    kept = {name: t for name, t in tensors.items() if not name.startswith("familiarity.")}
    blob = save(kept, metadata={"kinecast": json.dumps(metadata)})
    with pytest.raises(CheckpointError, match="without a model of familiarity"):
        load_personal(blob, predictor, base_sha256=BASE)
