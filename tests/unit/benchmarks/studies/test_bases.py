from dataclasses import replace

import pytest
import torch

from benchmarks.studies import bases
from benchmarks.studies.bases import (
    BUDGET_STEPS,
    find_sha256,
    list_recipes,
    load_net,
    train_base,
)
from benchmarks.studies.cache import Cache
from benchmarks.studies.recordings import is_examinee
from models.checkpoint import SHIPPED, CheckpointError, load_checkpoint
from models.data.augment import mirror
from models.training.config import PretrainConfig


def people_of(recipe, place):
    return {"/".join(clip.person) for clip in recipe.select(place)}


def test_nobody_who_only_tests_ever_trains(place):
    for recipe in list_recipes().values():
        assert not any(is_examinee(person) for person in people_of(recipe, place)), recipe.name


def test_who_trains_which_base(place):
    recipes = list_recipes()
    odd = {f"utd-mhad/{subject}" for subject in (1, 3, 5, 7)}
    others = {"precog/1", "wmft/1"}
    assert people_of(recipes["shipped-1"], place) == odd | others
    assert people_of(recipes["paper-0"], place) == odd
    assert people_of(recipes["without-utd-mhad-3"], place) == (odd | others) - {"utd-mhad/3"}
    assert people_of(recipes["without-wmft"], place) == odd | {"precog/1"}
    assert people_of(recipes["without-utd-mhad"], place) == others
    for name, recipe in recipes.items():
        if name.startswith("ablation-"):
            assert people_of(recipe, place) == (odd | others) - {"utd-mhad/7"}


def test_recipes_differ_in_what_they_say(place):
    recipes = list_recipes()
    assert recipes["shipped-0"].config == PretrainConfig()
    assert recipes["paper-2"].config == replace(PretrainConfig(), seed=2)
    assert recipes["without-precog"].config.steps == BUDGET_STEPS
    keys = {recipe.key(place) for recipe in recipes.values()}
    assert len(keys) == len(recipes)


def test_the_shipped_base_is_never_trained(place):
    recipe = list_recipes()["shipped-0"]
    assert recipe.path(place) == SHIPPED
    assert find_sha256(recipe, place) == load_checkpoint(SHIPPED).sha256


@pytest.mark.parametrize("name", [n for n in list_recipes() if n.startswith("ablation-")])
def test_an_ablated_base_is_trained_found_and_loaded(name, lab):
    recipe = lab.recipes[name]
    row = train_base(recipe, lab.place)
    blob = recipe.path(lab.place).read_bytes()
    assert find_sha256(recipe, lab.place) == row["sha256"]
    assert not list(bases.FOLDER.glob("*.state"))
    net = load_net(blob)
    windows = torch.randn(2, 15, 20, 3)
    off = (mirror(net(mirror(windows))) - net(windows)).abs().max()
    assert (off < 1e-5) == recipe.config.symmetric
    if recipe.part:
        with pytest.raises(CheckpointError, match="format"):
            load_checkpoint(blob)
    else:
        assert load_checkpoint(blob).sha256 == row["sha256"]


def test_equal_recipes_give_equal_files(lab):
    recipe = lab.recipes["without-precog"]
    first = train_base(recipe, lab.place)["sha256"]
    recipe.path(lab.place).unlink()
    assert train_base(recipe, lab.place)["sha256"] == first


def test_a_killed_run_goes_on_to_the_same_weights(lab, monkeypatch):
    recipe = lab.recipes["ablation-no-spl"]
    recipe = replace(recipe, config=replace(recipe.config, evaluate_every=1))  # saves every step
    path, train = recipe.path(lab.place), bases.pretrain

    def stop(*args, report, **kwargs):
        def tell(progress):
            report(progress)
            if progress.step == 2:
                raise KeyboardInterrupt

        return train(*args, report=tell, **kwargs)

    whole = train_base(recipe, lab.place)
    path.unlink()
    monkeypatch.setattr(bases, "pretrain", stop)
    with pytest.raises(KeyboardInterrupt):
        train_base(recipe, lab.place)
    assert not path.exists()
    monkeypatch.setattr(bases, "pretrain", train)
    row = train_base(recipe, lab.place)
    assert row["steps_of_this_run"] == 2
    assert row["sha256"] == whole["sha256"]


def test_a_base_that_is_there_is_described_and_not_trained_again(lab):
    recipe = lab.recipes["paper-1"]
    row = train_base(recipe, lab.place)
    again = train_base(recipe, lab.place)
    assert (row["steps_of_this_run"], again["steps_of_this_run"]) == (3, 0)
    assert {name: row[name] for name in ("sha256", "recipe", "data", "torch")} == {
        name: again[name] for name in ("sha256", "recipe", "data", "torch")
    }


def test_a_base_whose_file_is_gone_is_known_by_its_row(lab):
    recipe = lab.recipes["paper-1"]
    assert find_sha256(recipe, lab.place) is None
    row = train_base(recipe, lab.place)
    Cache(bases.RESULTS / "bases.jsonl").add({"key": "k", "unit": recipe.name, **row})
    recipe.path(lab.place).unlink()
    assert find_sha256(recipe, lab.place) == row["sha256"]
