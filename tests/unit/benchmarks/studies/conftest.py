"""Synthetic collections in the files that studies read, and bases that take no time to train."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from benchmarks.studies import bases, personal
from benchmarks.studies.recordings import Place
from benchmarks.studies.study import Lab
from models.data.synthetic import SyntheticPerson
from models.training.finetune import FinetuneConfig
from models.training.simlpe import SimlpeConfig
from tests.nets import SMALL

ACTIONS = ("wave", "squat", "punch", "throw", "reach")
FRAMES, LONG = 70, 140


def write_collection(path, subjects, trials, *, frames=FRAMES):
    takes = [(s, a, t) for s in subjects for a in range(len(ACTIONS)) for t in trials]
    poses = [
        SyntheticPerson(subject).record(ACTIONS[action], frames / 30, take=trial)
        for subject, action, trial in takes
    ]
    names = np.array([[str(s), str(a + 1), str(t)] for s, a, t in takes])
    np.savez(
        path,
        frames=np.concatenate(poses),
        lengths=np.full(len(poses), frames),
        subject=names[:, 0],
        action=names[:, 1],
        trial=names[:, 2],
        rate_hz=np.array(30.0),
    )


@pytest.fixture(scope="session")
def place(tmp_path_factory):
    folder = tmp_path_factory.mktemp("collections")
    write_collection(folder / "utd-mhad.npz", range(1, 8), range(1, 5))
    write_collection(folder / "precog.npz", (1, 7), (1,), frames=LONG)
    write_collection(folder / "wmft.npz", (1, 15), (1,), frames=LONG)
    return Place(folder / "utd-mhad.npz", folder)


@pytest.fixture
def lab(place, tmp_path, monkeypatch):
    """A lab with the recipes of the studies, in sizes and steps of a test."""
    monkeypatch.setattr(bases, "FOLDER", tmp_path / "bases")
    monkeypatch.setattr(bases, "RESULTS", tmp_path / "results")
    monkeypatch.setattr(personal, "FinetuneConfig", partial(FinetuneConfig, steps=3, copies=1))
    lab = Lab(place)
    lab.__dict__["recipes"] = {name: shrink(one) for name, one in bases.list_recipes().items()}
    return lab


def shrink(recipe):
    if isinstance(recipe.config, SimlpeConfig):
        return replace(recipe, config=replace(recipe.config, steps=3, batch=16))
    heading = recipe.config.net.canonical_heading
    net = replace(SMALL, canonical_heading=heading)
    config = replace(recipe.config, net=net, steps=3, batch=16, evaluate_every=3)
    return replace(recipe, config=config)
