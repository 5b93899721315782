import pytest

from models.metrics import FRAMES, Scores
from models.training.compare import divide, gather_cells, summarise
from models.training.evaluate import PUBLISHED, Row


def row(method: str, subject: str, errors: tuple[float, ...]) -> Row:
    return Row(method, subject, 10, 2, Scores(FRAMES, errors, errors, errors))


def of_paper(method: str, subject: str, factors: tuple[float, ...]) -> Row:
    values = PUBLISHED["paper: base" if method == "base" else "paper: personal", subject]
    return row(method, subject, tuple(a * b for a, b in zip(values, factors, strict=True)))


def test_the_mean_ratios_and_the_worst_cell_are_those_of_all_subjects() -> None:
    rows = [
        of_paper("base", "2", (0.9, 0.7, 0.5, 0.5, 0.5, 0.5)),
        of_paper("base", "4", (0.5, 0.5, 0.6, 0.6, 0.6, 0.6)),
        of_paper("personal", "2", (0.4,) * 6),
    ]
    before, after = summarise(gather_cells(rows, published=True))
    assert (before.method, before.reference, before.subjects) == ("base", "paper: base", ("2", "4"))
    assert before.early == pytest.approx((0.9 + 0.7 + 0.5 + 0.5) / 4)
    assert before.late == pytest.approx(0.55)
    assert before.worst.ratio == pytest.approx(0.9)
    assert (before.worst.subject, before.worst.frame) == ("2", 2)
    assert after.subjects == ("2",)
    assert (after.early, after.late) == (pytest.approx(0.4), pytest.approx(0.4))
    assert before.as_json()["worst"]["frame"] == 2


def test_ours_is_divided_by_the_peers_where_it_is_there() -> None:
    rows = [row("base", "1", (2.0,) * 6), row("simlpe", "1", (4.0,) * 6)]
    (only,) = summarise(gather_cells(rows, published=True))
    assert (only.reference, only.late) == ("simlpe", 0.5)


def test_the_papers_rows_are_taken_only_under_its_protocol() -> None:
    rows = [of_paper("base", "2", (1.0,) * 6)]
    assert set(gather_cells(rows, published=False)) == {("base", "2")}
    assert summarise(gather_cells(rows, published=False)) == []
    assert {subject for _, subject in gather_cells(rows, published=True)} == {"2"}


def test_rows_that_are_missing_give_no_ratio() -> None:
    cells = gather_cells([row("base", "1", (2.0,) * 6)], published=True)
    assert divide(cells, "base", "base", "1") == [1.0] * 6
    assert divide(cells, "base", "simlpe", "1") is None
