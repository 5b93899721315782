"""What a process makes of weights that are not what they claim to be."""

import hashlib
import json
from typing import Any

import pytest
import torch
from safetensors.torch import save

from app.live.decoders import Decoders, UnusableWeightsError
from models.checkpoint import dump_checkpoint
from models.predictor import Predictor
from tests.nets import TINY
from tests.versions import BASE_SHA256, dump, make_net, make_personal

BASE = make_net()


def make_foreign(**metadata: Any) -> bytes:
    """The file of another base, with something else in its header."""
    return dump_checkpoint(Predictor(config=TINY), metadata)


def write(metadata: object, **tensors: torch.Tensor) -> bytes:
    return save(tensors, metadata={"kinecast": json.dumps(metadata)})


@pytest.mark.parametrize(
    "base",
    [
        b"nonsense",
        write({"format": "kinecast-base-1"}),
        make_foreign(config=None),
        make_foreign(config={"hidden": "wide"}),
        make_foreign(config={"hidden": -1}),
        make_foreign(spec={"joints": 20, "toes": 10}),
        make_foreign(spec=7),
        write(
            {**Predictor(config=TINY).describe(), "format": "kinecast-base-1"},
            **{"adversary.x": torch.zeros(1)},
        ),
    ],
)
def test_a_malformed_base_is_unusable(base: bytes) -> None:
    sha256 = hashlib.sha256(base).hexdigest()
    blob = dump(make_personal(BASE, 1), base_sha256=sha256)
    with pytest.raises(UnusableWeightsError):
        Decoders(BASE, base_sha256=BASE_SHA256).build(blob, base_sha256=sha256, base=base)


@pytest.mark.parametrize(
    "blob",
    [
        b"",
        write([]),
        write({"format": "kinecast-personal-1", "base_sha256": BASE_SHA256}),
        write(
            {"format": "kinecast-personal-2", "base_sha256": BASE_SHA256, "familiarity": 3},
            **{"familiarity.mean": torch.zeros(2)},
        ),
    ],
)
def test_a_malformed_decoder_is_unusable(blob: bytes) -> None:
    with pytest.raises(UnusableWeightsError):
        Decoders(BASE, base_sha256=BASE_SHA256).build(blob)
