"""Every study computes a row of every kind on tiny synthetic people, and sums it up."""

import json
from functools import partial

import pytest

from benchmarks.studies import ablation, everybody, growth, main, peers, seconds, unseen, wild
from benchmarks.studies.bases import train_base
from benchmarks.studies.measured import Measured
from benchmarks.studies.runner import name_row
from benchmarks.studies.study import Options
from models.baselines import Ridge
from models.training.simlpe import SimlpeFinetune


def compute(study, name, lab, *people):
    """Train the unit's base, compute its row, and write and read it."""
    (unit,) = (unit for unit in study.plan(Options(people)) if unit.name == name)
    if unit.base and not unit.base.startswith("shipped-0"):
        train_base(lab.recipes[unit.base], lab.place)
    row = {**name_row(unit), **study.compute(unit, lab)}
    return json.loads(json.dumps(row))


def methods_of(row):
    return set(Measured.from_json(row["errors"]).sums)


@pytest.mark.parametrize(
    ("study", "name"),
    [
        (everybody.STUDY, "subject 3, trial 2"),
        (main.STUDY, "paper-1, subject 4"),
        (unseen.STUDY, "utd-mhad/2, draw 0"),
    ],
)
def test_versions_are_compared_with_and_without_judge_and_gate(study, name, lab, monkeypatch):
    monkeypatch.setattr(unseen, "draw_actions", lambda _: ["1", "2", "3", "4"])
    row = compute(study, name, lab)
    assert methods_of(row) == {"zero_velocity", "base", "served", "plain"}
    fitted_to = row.get("trial", "1")
    assert set(Measured.from_json(row["errors"]).trials) == {"1", "2", "3", "4"} - {fitted_to}
    assert row["verdict"] in {"promote", "reject", "too_little_data"}
    assert study.headline(row)
    assert all(table.rows is not None for table in study.summarise([row]))


def test_growth_is_tested_on_the_last_trial(lab):
    row = compute(growth.STUDY, "utd-mhad/2, trials 1 to 2", lab)
    assert row["trials"] == ["1", "2"]
    assert set(Measured.from_json(row["errors"]).trials) == {"4"}
    assert growth.STUDY.headline(row)
    assert len(growth.STUDY.summarise([row])) == 2


def test_the_ridge_is_a_peer_of_the_protocol(lab, monkeypatch):
    fit = partial(Ridge.fit, strengths=(1e-3,), adaptations=(10.0,))
    monkeypatch.setattr(Ridge, "fit", fit)
    row = compute(main.STUDY, "ridge-0, subject 2", lab)
    assert methods_of(row) == {"zero_velocity", "base", "plain"}
    assert main.STUDY.headline(row)


def test_the_correction_in_closed_form_has_the_same_base(lab):
    row = compute(main.STUDY, "closed-form-paper-1, subject 2", lab)
    assert row["base"] == "paper-1"
    found = Measured.from_json(row["errors"])
    assert methods_of(row) == {"zero_velocity", "base", "plain"}
    assert found.cm2("base") != found.cm2("plain")


def test_a_simlpe_is_trained_and_fine_tuned(lab, monkeypatch):
    monkeypatch.setattr(peers, "SimlpeFinetune", partial(SimlpeFinetune, steps=2))
    row = compute(main.STUDY, "simlpe-paper-1, subject 2", lab)
    assert methods_of(row) == {"zero_velocity", "base", "plain"}
    found = Measured.from_json(row["errors"])
    assert found.cm2("base") != found.cm2("plain")


@pytest.mark.parametrize(
    "name", ["new people, utd-mhad/4", "new collection, wmft/15", "personal, precog/7"]
)
def test_people_in_the_wild(name, lab):
    row = compute(wild.STUDY, name, lab)
    assert ("served" in methods_of(row)) == name.startswith("personal")
    assert wild.STUDY.headline(row)
    assert wild.STUDY.summarise([row])


@pytest.mark.parametrize("name", ["every part", "ablation-no-spl", "ablation-no-decoder-attention"])
def test_ablated_bases_are_fitted(name, lab):
    row = compute(ablation.STUDY, name, lab)
    assert methods_of(row) == {"zero_velocity", "base", "plain", "gated"}
    assert ablation.STUDY.headline(row)


def test_a_fit_of_the_whole_net_has_a_row(lab, monkeypatch):
    config = ablation.FinetuneConfig(steps=2)
    monkeypatch.setattr(ablation, "FinetuneConfig", lambda: config)
    row = compute(ablation.STUDY, "whole net fitted, rate 0.001", lab)
    assert methods_of(row) == {"zero_velocity", "base", "plain", "gated"}


def test_a_fit_within_a_budget_says_what_it_cost(lab):
    row = compute(seconds.STUDY, "utd-mhad/3, 1 s", lab, "utd-mhad/3")
    assert row["steps"] >= 1
    assert row["windows"] == 5 * 41 * row["copies"]
    assert methods_of(row) == {"zero_velocity", "base", "plain", "gated"}
    assert seconds.STUDY.headline(row)


@pytest.mark.parametrize("judged", ["with", "without"])
def test_runs_are_timed(judged, lab, monkeypatch):
    config = seconds.FinetuneConfig(steps=2, copies=1)
    monkeypatch.setattr(seconds, "FinetuneConfig", lambda: config)
    monkeypatch.setattr(seconds, "personalize", lambda *_, **__: None)
    row = compute(seconds.STUDY, f"utd-mhad/2, {judged} judge, 1 threads", lab)
    assert row["run_s"] >= 0
    assert seconds.STUDY.headline(row)
    assert len(seconds.STUDY.summarise([row])) == 2


def test_a_closed_form_has_a_line_beside_the_fits(lab, monkeypatch):
    monkeypatch.setitem(seconds.CORRECTIONS, "nothing", lambda net, trial: net)
    row = compute(seconds.STUDY, "utd-mhad/3, nothing", lab, "utd-mhad/3")
    found = Measured.from_json(row["errors"])
    assert found.ratio("plain", "base") == 1.0
    (fits, _) = seconds.STUDY.summarise([row])
    assert [line[2] for line in fits.rows] == ["-", "nothing"]
