"""Figures are drawn from the rows that are there, and say what is missing."""

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.figures import __main__ as figures
from benchmarks.figures import rows
from benchmarks.figures.latent import find_directions, find_nearest
from benchmarks.figures.people import draw_poses
from benchmarks.figures.rows import MissingError
from benchmarks.figures.tables import draw_seconds
from models.data.splits import TEST_SUBJECTS
from models.metrics import FRAMES


def make_row(subject: str, seed: int) -> dict[str, object]:
    methods = {"zero_velocity": 9.0, "base": 4.0, "served": 3.0 + seed, "plain": 3.0}
    return {
        "unit": f"shipped-{seed}, subject {subject}",
        "person": f"utd-mhad/{subject}",
        "family": "shipped",
        "seed": seed,
        "errors": {
            "actions": ["1", "2"],
            "trials": ["2", "3"],
            "windows": [10, 20],
            "mean_cm2": {name: [[size] * len(FRAMES)] * 2 for name, size in methods.items()},
        },
    }


def draw(folder: Path, monkeypatch: pytest.MonkeyPatch, *names: str) -> int:
    monkeypatch.setattr("sys.argv", ["figures", *names, "--folder", str(folder)])
    with pytest.raises(SystemExit) as ended:
        figures.main()
    return int(ended.value.code or 0)


@pytest.fixture
def results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(rows, "RESULTS", tmp_path)
    return tmp_path


def test_figures_show_the_rows_and_do_not_change_by_themselves(
    results: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lines = [json.dumps(make_row(one, seed)) for one in TEST_SUBJECTS for seed in (0, 1)]
    (results / "main.jsonl").write_text("\n".join(lines))
    folder = results / "figures"
    assert draw(folder, monkeypatch, "table", "horizon", "actions") == 0
    first = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert set(first) == {"table.svg", "horizon.svg", "actions.svg"}
    assert draw(folder, monkeypatch, "table") == 0
    assert (folder / "table.svg").read_bytes() == first["table.svg"]


def make_second(subject: str, **settings: object) -> dict[str, object]:
    methods = {"base": 4.0, "plain": 3.5, "gated": 3.0}
    kept = {"windows": [10], "actions": ["1"], "trials": ["2"]}
    errors = kept | {"mean_cm2": {name: [[size] * len(FRAMES)] for name, size in methods.items()}}
    name = "-".join(str(value) for value in settings.values())
    row = {"unit": f"{subject}, {name}", "person": f"utd-mhad/{subject}", "errors": errors}
    return row | {"fit_s": 0.8 * float(str(settings.get("budget_s", 1))), "gate_s": 1.0} | settings


@pytest.mark.parametrize("subjects", ["2", "246"])
def test_seconds_are_drawn_for_who_was_measured(
    subjects: str, results: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = [make_second(one, budget_s=budget) for one in subjects for budget in (1, 5, 20)]
    found += [make_second(one, correction="closed form") for one in subjects]
    (results / "seconds.jsonl").write_text("\n".join(json.dumps(row) for row in found))
    panels = draw_seconds().axes
    assert [axis.get_title() for axis in panels] == [f"subject {one}" for one in subjects]
    for axis in panels:
        lines = [(list(line.get_xdata()), list(line.get_ydata())) for line in axis.get_lines()]
        assert lines == [
            ([1.8, 5.0, 17.0], [0.75] * 3),  # gate and correction take a second more
            ([0.8, 4.0, 16.0], [0.875] * 3),
            ([0.8], [0.875]),
        ]


def test_what_was_not_measured_is_not_drawn_but_said(
    results: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert draw(results / "figures", monkeypatch, "table", "seconds") == 1
    told = capsys.readouterr().out
    assert "make study-main" in told
    assert "make study-seconds" in told
    assert not (results / "figures").exists()


def test_without_recordings_it_says_where_to_point(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("UTD_MHAD", "nowhere")
    with pytest.raises(MissingError, match="UTD_MHAD"):
        draw_poses()


def test_directions_tell_labels_apart_where_the_spread_does_not() -> None:
    random = np.random.default_rng(0)
    labels = np.repeat([3, 5, 9], 200)
    z = random.normal(size=(600, 4)) * [5.0, 1.0, 1.0, 1.0]  # the first says nothing
    z[:, 1] += 10.0 * (labels == 5)
    z[:, 2] += 4.0 * (labels == 9)
    directions = find_directions(z, labels)
    assert directions.shape == (4, 2)
    best = np.abs(directions) / np.linalg.norm(directions, axis=0)
    assert best[[0, 3]].max() < 0.1
    assert best[1, 0] > best[2, 0]
    placed = z @ directions
    assert np.std(placed[labels == 3], axis=0) == pytest.approx(1.0, abs=0.15)
    centres = {kind: placed[labels == kind].mean(axis=0) for kind in (3, 5, 9)}
    assert np.mean(find_nearest(placed, centres) == labels) > 0.95
