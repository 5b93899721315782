import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import save

from models.checkpoint import (
    CheckpointError,
    dump_checkpoint,
    load_checkpoint,
    parse_blob,
    save_checkpoint,
)
from models.latent import Adversary
from models.predictor import Predictor
from models.uncertainty import LEVELS, RadiusTable
from tests.nets import SMALL


def make_radius() -> RadiusTable:
    table = np.linspace(0.01, 0.2, len(LEVELS), dtype=np.float32)[:, None, None]
    return RadiusTable(np.broadcast_to(table, (len(LEVELS), 15, 20)).copy(), LEVELS, "nobody")


def test_a_checkpoint_gives_back_the_same_forecasts(
    predictor: Predictor, synthetic_windows: torch.Tensor, tmp_path: Path
) -> None:
    sha256 = save_checkpoint(
        tmp_path / "a.safetensors", predictor, {"note": 1}, radius=make_radius()
    )
    loaded = load_checkpoint(tmp_path / "a.safetensors")
    window = synthetic_windows[:, :15]
    assert torch.allclose(loaded.predictor(window), predictor(window), atol=1e-6)
    assert all(torch.equal(a, b) for a, b in _pairs(loaded.predictor, predictor))
    assert loaded.sha256 == sha256
    assert loaded.metadata["note"] == 1
    assert loaded.radius is not None
    assert loaded.radius.calibrated_on == "nobody"
    assert np.array_equal(loaded.radius.table, make_radius().table)
    assert not (tmp_path / "a.safetensors.part").exists()


def test_the_same_net_gives_the_same_bytes(predictor: Predictor) -> None:
    assert dump_checkpoint(predictor, {"a": 1}) == dump_checkpoint(predictor, {"a": 1})


@settings(max_examples=30, deadline=None)
@given(st.binary(max_size=200))
def test_noise_is_no_checkpoint(blob: bytes) -> None:
    with pytest.raises(CheckpointError, match="not a Kinecast checkpoint"):
        load_checkpoint(blob)


def _pairs(one: Predictor, other: Predictor) -> Iterable[tuple[torch.Tensor, torch.Tensor]]:
    return zip(one.state_dict().values(), other.state_dict().values(), strict=True)


def tampered(
    predictor: Predictor, *, radius_table: torch.Tensor | None = None, **changes: Any
) -> bytes:
    described = {"format": "kinecast-base-1", **predictor.describe()}
    from models.skeleton import KINECT_V1

    described |= {"skeleton": list(KINECT_V1.joints)} | changes
    state = {"net." + k: v.contiguous() for k, v in predictor.state_dict().items()}
    if radius_table is not None:
        state["radius"] = radius_table
    return save(state, metadata={"kinecast": json.dumps(described)})


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"format": "other"}, "format 'other'"),
        ({"skeleton": ["head"]}, "another skeleton"),
        ({"config": {"encoder_hidden": 24}}, "do not fit"),
        ({"config": {"turbo": 1}}, "unknown to this version"),
    ],
)
def test_what_does_not_fit_is_refused_with_the_reason(
    predictor: Predictor, changes: dict[str, Any], words: str
) -> None:
    with pytest.raises(CheckpointError, match=words):
        load_checkpoint(tampered(predictor, **changes))


def test_a_file_without_our_metadata_is_refused() -> None:
    with pytest.raises(CheckpointError, match="not a Kinecast checkpoint"):
        load_checkpoint(save({"a": torch.zeros(1)}))


GOOD_TABLE = torch.ones(2, 15, 20)
DESCRIBED = {"levels": [0.5, 0.9], "calibrated_on": "nobody"}


@pytest.mark.parametrize(
    ("table", "changes", "words"),
    [
        (GOOD_TABLE, {}, "'radius' is missing"),
        (GOOD_TABLE, {"radius": {"levels": [0.5, 0.9]}}, "'calibrated_on' is missing"),
        (GOOD_TABLE, {"radius": DESCRIBED | {"levels": 3}}, "bad table"),
        (GOOD_TABLE, {"radius": DESCRIBED | {"levels": [0.5]}}, "1 levels"),
        (GOOD_TABLE * torch.nan, {"radius": DESCRIBED}, "finite"),
        (torch.ones(2), {"radius": DESCRIBED}, "levels x 15 x 20"),
        (GOOD_TABLE.double(), {"radius": DESCRIBED}, "float32"),
    ],
)
def test_bad_table_of_radii_is_refused(
    predictor: Predictor, table: torch.Tensor, changes: dict[str, Any], words: str
) -> None:
    blob = tampered(predictor, radius_table=table, **changes)
    with pytest.raises(CheckpointError, match=words):
        load_checkpoint(blob)


@pytest.mark.parametrize("lost", ["config", "spec", "pretraining"])
def test_a_checkpoint_that_does_not_describe_its_net_is_refused(lost: str) -> None:
    net = Predictor(config=SMALL)
    size = {"continuous": SMALL.continuous, "categories": SMALL.categories}
    blob = dump_checkpoint(
        net, {"pretraining": {"adversary_hidden": 8}}, adversary=Adversary(**size, hidden=8)
    )
    metadata, tensors = parse_blob(blob)
    del metadata[lost]
    broken = save({**tensors}, metadata={"kinecast": json.dumps(metadata)})
    with pytest.raises(CheckpointError, match="described"):
        load_checkpoint(broken)
