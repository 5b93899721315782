"""The shipped base model holds every part of the paper, and every part has a say."""

import pytest
import torch

from models.checkpoint import SHIPPED, Checkpoint, load_checkpoint
from models.data.augment import mirror
from models.data.splits import EXAMINATION, TEST_SUBJECTS
from models.data.synthetic import synthetic_clips
from models.data.windows import cut_windows
from models.predictor import Predictor
from models.skeleton import KINECT_V1
from models.spec import MotionSpec
from tests.unit.models.test_predictor import FORECAST_PATH


@pytest.fixture(scope="module")
def shipped() -> Checkpoint:
    return load_checkpoint(SHIPPED)


@pytest.fixture(scope="module")
def windows() -> torch.Tensor:
    cut = cut_windows(synthetic_clips(3, seed=5), MotionSpec(), stride=20)
    return torch.as_tensor(cut.observed)


def test_it_fits_the_size_that_is_promised(shipped: Checkpoint) -> None:
    assert SHIPPED.stat().st_size <= 4_000_000
    assert sum(p.numel() for p in shipped.predictor.decoder.parameters()) <= 350_000
    assert shipped.metadata["parameters"]["decoder"] <= 350_000


def test_each_part_of_the_paper_is_in_it(shipped: Checkpoint) -> None:
    net = shipped.predictor
    assert set(net.encoder.streams) == {"position", "velocity", "acceleration"}
    assert not any(stream.bidirectional for stream in net.encoder.streams.values())
    assert net.encoder.attention.heads > 1
    assert net.latent.to_z.out_features == net.config.continuous
    assert net.latent.to_c.out_features == net.config.categories > 1
    assert isinstance(net.decoder.cell, torch.nn.GRUCell)
    assert net.decoder.predict.joints == len(KINECT_V1.joints)
    assert shipped.metadata["pretraining"]["adversarial_weight"] > 0
    assert shipped.adversary is not None


@pytest.mark.parametrize("part", FORECAST_PATH)
def test_switching_off_a_part_of_the_path_changes_forecasts(
    shipped: Checkpoint, windows: torch.Tensor, part: str
) -> None:
    changed = Predictor(shipped.predictor.spec, shipped.predictor.config).eval()
    changed.load_state_dict(shipped.predictor.state_dict())
    with torch.no_grad():
        for parameter in changed.get_submodule(part).parameters():
            parameter.zero_()
        moved = (changed(windows) - shipped.predictor(windows)).norm(dim=-1)
    assert moved.mean() > 1e-4, f"{part} moves a joint by {moved.mean() * 1000:.3f} mm only"


def test_it_says_who_trained_it_and_that_nobody_of_the_test_did(shipped: Checkpoint) -> None:
    data = shipped.metadata["data"]
    assert not set(data["utd-mhad"]["subjects"]) & set(TEST_SUBJECTS)
    trained = {(source, s) for source, found in data.items() for s in found["subjects"]}
    assert not trained & EXAMINATION
    assert shipped.metadata["command"].startswith("kinecast pretrain")
    assert shipped.metadata["commit"]
    assert shipped.metadata["left_out_scores"]


def test_it_has_a_radius_that_was_measured_on_people_left_out(shipped: Checkpoint) -> None:
    assert shipped.radius is not None
    people = shipped.radius.calibrated_on.replace("; ", ", ").split(", ")
    assert {source for source, _ in (person.split("/") for person in people)} >= {"utd-mhad"}
    assert not {person.split("/")[1] for person in people} & set(TEST_SUBJECTS)


def test_mirrored_people_get_mirrored_forecasts(shipped: Checkpoint, windows: torch.Tensor) -> None:
    forecast = shipped.predictor(windows)
    mirrored = mirror(shipped.predictor(mirror(windows)))
    assert (
        float((forecast - mirrored).norm(dim=-1).max()) < 1e-4
    )  # metres; symmetric by construction
