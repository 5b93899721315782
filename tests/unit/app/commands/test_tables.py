import pytest

from app.commands.tables import show_comparison, show_measures
from models.metrics import FRAMES, Scores
from models.training.evaluate import PUBLISHED, Row

METHODS = {
    "zero_velocity": 2.4,
    "damped_velocity": 2.2,
    "ridge": 1.1,
    "ridge_personal": 1.0,
    "simlpe": 0.9,
    "simlpe_personal": 0.8,
    "base": 0.7,
    "personal": 0.5,
}


def make_rows() -> list[Row]:
    rows = []
    for subject in ("2", "4", "6"):
        for method, factor in METHODS.items():
            errors = tuple(factor * value for value in PUBLISHED["paper: base", subject])
            rows.append(Row(method, subject, 10, 2, Scores(FRAMES, errors, errors, errors)))
    return rows


def test_everything_is_on_one_screen_beside_the_paper(capsys: pytest.CaptureFixture[str]) -> None:
    show_comparison(make_rows(), published=True)
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 100
    assert len(lines) <= 50
    assert not any("…" in line for line in lines)
    (base,) = [line.split() for line in lines if line.split()[:2] == ["2", "base"]]
    assert base[2:] == ["3.79", "10.32", "23.71", "29.32", "35.93", "39.28", *["0.70"] * 6]
    (told,) = [line.split() for line in lines if line.startswith(" base ÷ paper: base")]
    assert told[4:7] == ["0.700", "0.700", "0.700"]
    assert [line.split("  ")[0].strip() for line in lines if " ÷ " in line][-4:] == [
        "base ÷ paper: base",
        "personal ÷ paper: personal",
        "base ÷ simlpe",
        "personal ÷ simlpe_personal",
    ]


def test_under_another_protocol_there_is_no_paper(capsys: pytest.CaptureFixture[str]) -> None:
    rows = [row for row in make_rows() if row.method in {"zero_velocity", "base"}]
    show_comparison(rows, published=False)
    assert "paper" not in capsys.readouterr().out
    show_measures(rows, published=True)
    shown = capsys.readouterr().out
    assert shown.count("paper: base") == 3
    assert "mean distance per joint in mm" in shown
