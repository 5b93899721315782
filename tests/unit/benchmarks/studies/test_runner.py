import io
import json
from dataclasses import replace

import pytest
from rich.console import Console

from benchmarks.studies import bases, runner
from benchmarks.studies.runner import Run, describe_missing, read_rows, run_study
from benchmarks.studies.study import Lab, Study, Unit, key_of
from benchmarks.studies.tables import Table

CALLS = []
BASE_S = bases.list_recipes()["paper-1"].seconds


def plan(_):
    return [
        Unit("one", "shipped-0", "utd-mhad/3", {"number": 1}, seconds=60),
        Unit("two", "shipped-0", "utd-mhad/2", {"number": 2}, seconds=60),
    ]


def compute(unit, lab):
    CALLS.append(unit.name)
    if unit.settings["number"] < 0:
        raise ValueError("this one fails")
    return {"value": unit.settings["number"] * 10}


def summarise(rows):
    return [Table("Values", ("unit", "value"), [(r["unit"], str(r["value"])) for r in rows])]


STUDY = Study("toy", "?", 1, plan, compute, lambda row: f"value {row['value']}", summarise)


@pytest.fixture
def run(place, tmp_path, monkeypatch):
    CALLS.clear()
    monkeypatch.setitem(runner.STUDIES, "toy", STUDY)
    return Run(place, jobs=1, folder=tmp_path, ledger=tmp_path / "readings.jsonl")


def go(study, run):
    told = io.StringIO()
    rows = run_study(study, run, Console(file=told, width=200))
    return rows, told.getvalue()


def test_rows_are_computed_once(run):
    rows, told = go(STUDY, run)
    assert [row["value"] for row in rows] == [10, 20]
    assert "toy one: value 10" in told
    assert "toy two: value 20" in told
    again, told = go(STUDY, run)
    assert again == rows
    assert CALLS == ["one", "two"]
    assert told == ""


def test_a_row_says_what_it_is_about(run):
    row = go(STUDY, run)[0][1]
    assert {**row, "seconds": 0, "key": ""} == {
        "unit": "two",
        "base": "shipped-0",
        "person": "utd-mhad/2",
        "number": 2,
        "key": "",
        "seconds": 0,
        "value": 20,
    }


def test_what_decides_a_row_decides_whether_it_is_computed_again(run):
    go(STUDY, run)
    newer = Study("toy", "?", 2, plan, compute, STUDY.headline, summarise)
    rows, _ = go(newer, run)
    assert CALLS == ["one", "two"] * 2
    assert len(rows) == 2
    assert len(run.cache(newer).read()) == 2


def test_fresh_computes_again_and_only_leaves_others_alone(run):
    go(STUDY, run)
    go(
        STUDY,
        Run(run.place, jobs=1, folder=run.folder, ledger=run.ledger, fresh=True, only=("t*",)),
    )
    assert CALLS == ["one", "two", "two"]


def test_every_reading_of_people_who_only_test_leaves_a_line(run):
    go(STUDY, run)
    go(STUDY, run)
    (line,) = [json.loads(text) for text in run.ledger.read_text().splitlines()]
    assert line["what"] == "python -m benchmarks.studies toy"
    assert line["config"]["people"] == ["utd-mhad/2"]
    assert set(line["config"]["bases"]) == {"shipped-0"}
    assert line["figures"]["rows"] == [["one", "10"], ["two", "20"]]


def test_one_bad_row_costs_no_other(run, monkeypatch, capsys):
    units = [Unit("bad", "", "", {"number": -1}), Unit("good", "", "", {"number": 1})]
    study = Study("toy", "?", 1, lambda _: units, compute, STUDY.headline, summarise)
    monkeypatch.setitem(runner.STUDIES, "toy", study)
    rows, told = go(study, run)
    assert [row["unit"] for row in rows] == ["good"]
    assert "toy bad: failed" in told
    assert "this one fails" in capsys.readouterr().err


def test_what_is_missing_is_told_with_its_time(run):
    assert describe_missing(STUDY, run)[-1] == "toy: 2 rows and 0 bases, about 2 min with 1 jobs"
    go(STUDY, run)
    assert describe_missing(STUDY, run)[-1] == "toy: 0 rows and 0 bases, about 0 min with 1 jobs"


def test_rows_are_read_without_recordings(run, tmp_path):
    go(STUDY, run)
    nowhere = Run(runner.Place(tmp_path / "none", tmp_path / "none"), folder=run.folder)
    assert len(read_rows(STUDY, nowhere)) == 2


def test_rows_with_a_base_come_before_the_other_bases(run, monkeypatch):
    units = [
        Unit("late", "paper-1", "", {"number": 1}),
        Unit("early", "shipped-0", "", {"number": 2}),
    ]
    study = Study("toy", "?", 1, lambda _: units, compute, STUDY.headline, summarise)
    monkeypatch.setitem(runner.STUDIES, "toy", study)
    monkeypatch.setattr(bases, "FOLDER", run.folder / "bases")

    def train(unit, lab):
        CALLS.append(unit.name)
        path = lab.find_base(unit.name)
        path.parent.mkdir()
        path.write_bytes(b"a base")
        return {"recipe": "", "sha256": "", "steps": 1, "training_s": 0}

    fake = replace(runner.training.STUDY, compute=train)
    monkeypatch.setattr(runner.training, "STUDY", fake)
    monkeypatch.setitem(runner.STUDIES, "bases", fake)
    assert f"toy, base paper-1: {BASE_S:.0f} s" in describe_missing(study, run)
    rows, _ = go(study, run)
    assert CALLS == ["early", "paper-1", "late"]
    assert len(rows) == 2


def test_rows_of_a_study_have_different_keys(place):
    lab = Lab(place)
    for study in runner.STUDIES.values():
        keys = [key_of(study, unit, lab) for unit in study.plan(runner.Options())]
        known = [key for key in keys if key is not None]
        assert len(known) == len(set(known))


def test_studies_have_different_names_and_units():
    for study in runner.STUDIES.values():
        names = [unit.name for unit in study.plan(runner.Options())]
        assert len(names) == len(set(names)) > 0
