"""What rounds come to: estimates, tables, the figure, and the choice of constants."""

import json
from dataclasses import replace
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from benchmarks.planning import __main__ as command
from benchmarks.planning import tune
from benchmarks.planning.figure import draw
from benchmarks.planning.measures import MEASURES, Estimate, Tally, draw_clips, estimate
from benchmarks.planning.people import METHODS, find_version
from benchmarks.planning.report import Report
from benchmarks.planning.robot import Constants
from benchmarks.planning.rounds import Round
from tests.conftest import ROOT

MARGINS = (0.1, 0.2)


def make_round(closest=0.2, *, close=0.0, seconds=2.0, goals=1):
    return Round(
        seconds=seconds,
        closest_m=closest,
        too_close_s=close,
        goals=goals,
        progress_m=1.0,
        path_m=1.5,
        changes=4,
    )


def make_tally(shift=0.0):
    random = np.random.default_rng(3)
    gaps = random.normal(0.2, 0.05, size=40)
    return Tally.count([[make_round(gap + shift, close=max(0, 0.2 - gap))] for gap in gaps])


@pytest.fixture
def report():
    tallies = {(m, name): make_tally(0.01 * k) for m in MARGINS for k, name in enumerate(METHODS)}
    return Report(Constants(margin=0.2), tallies, {"2": 40}, "ab12")


def test_measures_are_ratios_of_sums_over_all_rounds():
    tally = Tally.count(
        [[make_round(0.1, close=0.5, goals=2), make_round(0.3)], [make_round(-0.1, seconds=4.0)]]
    )
    found = {name: one.value for name, one in estimate(tally).items()}
    assert found["closest_cm"] == pytest.approx(10.0)
    assert found["too_close_s_per_min"] == pytest.approx(60 * 0.5 / 8)
    assert found["collisions_percent"] == pytest.approx(100 / 3)
    assert found["goals_per_min"] == pytest.approx(60 * 4 / 8)
    assert found["detour"] == pytest.approx(1.5)
    assert found["changes_per_s"] == pytest.approx(12 / 8)


def test_first_draw_is_every_clip_once_and_the_others_as_many():
    draws = draw_clips(7)
    assert (draws[0] == 1).all()
    assert (draws.sum(axis=1) == 7).all()


def test_interval_holds_the_mean_of_the_truth_and_narrows_in_pairs():
    one, other = make_tally(), make_tally(0.01)
    alone, paired = estimate(other)["closest_cm"], estimate(other, one)["closest_cm"]
    assert alone.low < 21.0 < alone.high
    assert paired.value == pytest.approx(1.0)
    assert paired.is_clear
    assert paired.high - paired.low < 0.1 * (alone.high - alone.low)


def test_tables_have_every_forecast_and_its_figures(report):
    main, differences, margins = report.make_tables()
    assert [row[0] for row in main.rows] == list(METHODS)
    assert len(main.columns) == len(main.rows[0]) == 1 + len(MEASURES)
    assert [row[0] for row in differences.rows][1] == "personal less base"
    assert differences.rows[1][1].startswith("+1.0 (")
    assert len(margins.rows) == len(MARGINS) * len(METHODS)


def test_report_survives_json_with_the_constants_as_they_were(report):
    kept = json.loads(json.dumps(report.as_json()))
    assert command.restore(kept["constants"]) == report.constants
    assert kept["base"] == "ab12"
    assert set(kept["margins"]) == {"0.1", "0.2"}
    assert kept["differences"]["0.2"]["base - zero velocity"]["closest_cm"]["value"] == 1.0


def test_figure_is_well_formed_and_names_every_forecast(report):
    words = " ".join(ET.fromstring(draw(report)).itertext())  # noqa: S314 - our own
    assert all(method in words for method in METHODS)


def test_constants_are_those_that_suit_zero_velocity_best(monkeypatch):
    def play(scene, method, task, constants):
        assert method == "zero velocity"
        good = constants.margin == 0.25 and constants.weight == 30.0
        return make_round(close=0.0 if good else 0.1)

    monkeypatch.setattr(tune, "play", play)
    chosen, tried = tune.choose_constants(["scene"], say=lambda _: None)
    assert chosen == replace(Constants(), weight=30.0, margin=0.25)
    assert len(tried) == len(tune.WEIGHTS) * len(tune.MARGINS)


def test_kept_version_is_not_fitted_again(tmp_path, monkeypatch):
    from models.data.clips import Clip

    monkeypatch.setattr(
        "benchmarks.planning.people.make_served", lambda *_: pytest.fail("fitted again")
    )
    monkeypatch.setattr("benchmarks.planning.people.make_key", lambda _: "key")
    (tmp_path / "key.safetensors").write_bytes(b"kept")
    clip = Clip(np.zeros((20, 20, 3), np.float32), "2", "1", "1", "utd-mhad")
    assert find_version([clip], say=print, folder=tmp_path) == b"kept"


KEPT = json.loads(command.JSON.read_text())
PAGE = (ROOT / "docs/planning.md").read_text()


def tell(found, *, sign=False):
    """Write kept figures as a row of a table."""
    estimates = {name: Estimate(**found[name]) for name in MEASURES}
    return " | ".join(one.tell(MEASURES[name].digits, sign=sign) for name, one in estimates.items())


@pytest.mark.parametrize("method", METHODS)
def test_page_has_the_figures_that_are_kept(method):
    chosen = f"{KEPT['constants']['margin']:g}"
    assert f"| {method} | {tell(KEPT['margins'][chosen][method])} |" in PAGE


def test_page_has_the_differences_that_are_kept():
    for names, found in KEPT["differences"][f"{KEPT['constants']['margin']:g}"].items():
        assert f"| {names.replace(' - ', ' less ')} | {tell(found, sign=True)} |" in PAGE


def test_kept_constants_are_the_best_of_those_that_were_tried():
    best = max(KEPT["tuned"], key=lambda row: row["score"])
    assert best["weight"] == KEPT["constants"]["weight"]
    assert best["margin"] == KEPT["constants"]["margin"]


def test_first_page_has_the_figures_that_are_kept():
    close = [KEPT["margins"]["0.2"][name]["too_close_s_per_min"]["value"] for name in METHODS[:3]]
    without, base, personal = (f"{value:.1f} s" for value in close)
    page = (ROOT / "README.md").read_text()
    assert f"than 10 cm for {without} a minute" in page
    assert f"{base} with the base's forecasts, {personal} with their own version's" in page
