"""Pretrain, calibrate and evaluate, as a researcher runs them, on a small synthetic collection."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from app.cli import app
from models.checkpoint import dump_checkpoint, load_checkpoint
from models.data.synthetic import SyntheticPerson
from models.data.synthetic_actions import ACTIONS
from models.predictor import Predictor
from models.training.simlpe_file import load_simlpe
from tests.nets import SMALL
from tests.unit.models.conftest import believable_motion

STEPS = ["--steps", "2", "--batch", "8"]


@pytest.fixture
def collection(tmp_path: Path) -> Path:
    """Six sequences of three people, in the documented keys."""
    people = ["1", "3", "2"]
    clips = [believable_motion(seed, 50) for seed in range(6)]
    path = tmp_path / "people.npz"
    np.savez(
        path,
        frames=np.concatenate(clips),
        lengths=np.array([len(clip) for clip in clips]),
        subject=np.array([people[seed % 3] for seed in range(6)]),
        action=np.array(["wave"] * 6),
        trial=np.array([str(1 + seed // 3) for seed in range(6)]),
        rate_hz=30.0,
    )
    return path


def run(*arguments: str | Path) -> str:
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    assert result.exit_code == 0, result.output
    return result.stdout


def test_from_recordings_to_a_calibrated_model_and_its_table(
    collection: Path, tmp_path: Path
) -> None:
    base, fold = tmp_path / "base.safetensors", tmp_path / "fold.safetensors"
    people = ["--subjects", "1,3"]
    run("pretrain", "--data", collection, *people, "--out", base, *STEPS)
    left_out = ["--leave-out", "people/3"]
    run("pretrain", "--data", collection, *people, "--out", fold, *left_out, *STEPS)
    run("calibrate", "--model", base, "--data", collection, "--fold", fold)
    checkpoint = load_checkpoint(base)
    assert checkpoint.radius is not None
    assert checkpoint.radius.calibrated_on == "people/3"
    assert not base.with_suffix(".state").exists()

    report = tmp_path / "figures.json"
    arguments = ["--data", collection, "--model", base, "--subjects", "2", "--baselines"]
    shown = run("evaluate", *arguments, "--json", report)
    assert "zero_velocity" in shown
    assert "coverage of the radius" in shown
    figures = json.loads(report.read_text())
    methods = [row["method"] for row in figures["rows"]]
    assert methods == ["zero_velocity", "base", "damped_velocity"]
    assert figures["simlpe"] is None
    assert figures["rows"][0]["frames"] == [2, 4, 8, 10, 13, 15]
    assert figures["protocol"]["model"]["sha256"] == checkpoint.sha256


def test_a_peer_is_trained_fine_tuned_and_compared_on_one_screen(
    collection: Path, tmp_path: Path
) -> None:
    base, peer = tmp_path / "base.safetensors", tmp_path / "peer.safetensors"
    torch.manual_seed(0)
    base.write_bytes(dump_checkpoint(Predictor(config=SMALL), {}))
    left_out = ["--subjects", "1,3", "--leave-out", "people/3"]
    run("pretrain-peer", "--data", collection, "--out", peer, "--steps", "2", *left_out)
    assert load_simlpe(peer).metadata["left_out"] == ["people/3"]

    ledger, report = tmp_path / "readings.jsonl", tmp_path / "figures.json"
    arguments = ["--data", collection, "--model", base, "--subjects", "2", "--test-trials", "2"]
    arguments += ["--baselines", "--simlpe", peer, "--finetune-steps", "3"]
    arguments += ["--log", ledger, "--json", report]
    shown = run("evaluate", *arguments)
    assert "base ÷ simlpe" in shown
    assert max(map(len, shown.splitlines())) <= 100
    figures = json.loads(report.read_text())
    assert [row["method"] for row in figures["rows"]] == [
        "zero_velocity",
        "base",
        "damped_velocity",
        "simlpe",
        "simlpe_personal",
    ]
    assert figures["simlpe"]["sha256"] == load_simlpe(peer).sha256
    assert [found["reference"] for found in figures["comparison"]] == ["simlpe"]
    everybody = run("evaluate", *arguments[:4], *arguments[8:11], "--json", "-")
    assert [row["method"] for row in json.loads(everybody)["rows"]][-1] == "simlpe"

    (line,) = [json.loads(line) for line in ledger.read_text().splitlines()]
    assert line["config"]["model"]["sha256"] == load_checkpoint(base).sha256
    assert line["config"]["data_sha256"] == figures["protocol"]["data_sha256"]
    assert [row["mse_cm2"] for row in line["figures"]] == [
        row["mse_cm2"] for row in figures["rows"]
    ]


def test_without_subjects_there_is_one_row_per_method(collection: Path, tmp_path: Path) -> None:
    base = tmp_path / "base.safetensors"
    run("pretrain", "--data", collection, "--subjects", "1,3", "--out", base, *STEPS)
    figures = json.loads(run("evaluate", "--data", collection, "--model", base, "--json", "-"))
    assert [(row["method"], row["subject"]) for row in figures["rows"]] == [
        ("zero_velocity", "all"),
        ("base", "all"),
    ]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["evaluate", "--data", "nowhere"], "nowhere"),
        (["evaluate", "--data", "{data}", "--personalize-trials", "1"], "needs --subjects"),
        (
            ["evaluate", "--data", "{data}", "--subjects", "1", "--personalize-trials", "1"],
            "cannot be tested on",
        ),
        (["evaluate", "--data", "{data}", "--model", "{data}"], "not a Kinecast checkpoint"),
        (["evaluate", "--data", "{data}", "--subjects", "99"], "subjects 99"),
        (["pretrain", "--data", "nowhere", "--out", "{out}"], "nowhere"),
        (["pretrain", "--data", "{data}", "--out", "{out}", "--leave-out", "7"], "utd-mhad/7"),
        (["pretrain", "--data", "{data}", "--out", "{out}", "--leave-out", "a/7"], "no clips of"),
        (["pretrain", "--data", "nowhere", "--out", "{folder}"], "is a folder"),
        (["pretrain", "--data", "nowhere", "--out", "{data}/a"], "is no folder"),
        (["evaluate", "--data", "nowhere", "--json", "{folder}/none/a.json"], "there is no folder"),
        (["evaluate", "--data", "nowhere", "--json", "{folder}"], "is a folder"),
        (["evaluate", "--data", "nowhere", "--log", "{folder}"], "is a folder"),
        (["evaluate", "--data", "nowhere", "--simlpe", "{data}"], "needs --baselines"),
        (
            ["evaluate", "--data", "{data}", "--baselines", "--simlpe", "{data}"],
            "not a Kinecast checkpoint",
        ),
        (["pretrain-peer", "--data", "{data}", "--out", "{folder}"], "is a folder"),
        (["pretrain-peer", "--data", "{data}", "--out", "{out}", "--leave-out", "a/7"], "no clips"),
    ],
)
def test_bad_usage_is_one_clear_line_and_exit_status_2(
    collection: Path, tmp_path: Path, arguments: list[str], words: str
) -> None:
    places = {
        "data": str(collection),
        "out": str(tmp_path / "out.safetensors"),
        "folder": str(tmp_path),
    }
    result = CliRunner().invoke(app, [argument.format(**places) for argument in arguments])
    assert result.exit_code == 2
    assert words in result.stderr.replace("\n", " ")
    assert "Traceback" not in result.output


@pytest.mark.parametrize("command", ["pretrain", "pretrain-peer"])
def test_who_only_tests_is_never_mixed_into_training(
    command: str, collection: Path, tmp_path: Path
) -> None:
    more, made = tmp_path / "utd-mhad.npz", tmp_path / "made.safetensors"
    more.write_bytes(collection.read_bytes())  # subjects 1, 2 and 3 under UTD-MHAD's name
    data = ["--data", collection, "--subjects", "1", "--mix", more]
    steps = STEPS if command == "pretrain" else STEPS[:2]
    run(command, *data, "--out", made, *steps)
    read = load_checkpoint if command == "pretrain" else load_simlpe
    used = read(made).metadata["data"]
    assert {source: one["subjects"] for source, one in used.items()} == {
        "people": ["1"],
        "utd-mhad": ["1", "3"],
    }


def test_a_person_is_fine_tuned_judged_and_scored(tmp_path: Path) -> None:
    clips = [SyntheticPerson(1).record(ACTIONS[i % 6], 2.0) for i in range(8)]
    people = tmp_path / "people.npz"
    np.savez(
        people,
        frames=np.concatenate(clips),
        lengths=np.array([len(clip) for clip in clips]),
        subject=np.array(["1"] * 8),
        action=np.array([ACTIONS[i % 6] for i in range(8)]),
        trial=np.array(["1"] * 6 + ["2"] * 2),
        rate_hz=30.0,
    )
    base = tmp_path / "base.safetensors"
    torch.manual_seed(0)
    base.write_bytes(dump_checkpoint(Predictor(config=SMALL), {}))
    arguments = ["--data", people, "--model", base, "--subjects", "1", "--test-trials", "2"]
    arguments += ["--finetune-steps", "3"]
    report = json.loads(run("evaluate", *arguments, "--personalize-trials", "1", "--json", "-"))
    rows = {row["method"]: row for row in report["rows"]}
    assert set(rows) == {"zero_velocity", "base", "personal"}
    version = rows["personal"]["version"]
    assert version["verdict"] in {"promote", "reject"}
    if version["verdict"] == "reject":
        assert rows["personal"]["mse_cm2"] == rows["base"]["mse_cm2"]
    else:
        assert rows["personal"]["mse_cm2"] != rows["base"]["mse_cm2"]
