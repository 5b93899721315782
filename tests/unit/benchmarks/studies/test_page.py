"""The tables of a page, written between its marks."""

import pytest

from benchmarks.studies.page import fill
from benchmarks.studies.recordings import Place
from benchmarks.studies.runner import Run, sum_up
from benchmarks.studies.tables import Table
from tests.conftest import ROOT

PAGE = "# A page\n\n<!-- rows of growth -->\nold\n<!-- end of rows -->\n\nProse.\n"


def test_tables_stand_between_the_marks_and_the_rest_stays():
    table = Table("Falls", ("trials", "error"), [("1", "0.7"), ("2", "0.6")])
    filled = fill(PAGE, lambda name: [table] if name == "growth" else [])
    assert filled.startswith("# A page\n\n<!-- rows of growth -->\n\nFalls\n\n| trials | error |")
    assert filled.endswith("| 2 | 0.6 |\n\n<!-- end of rows -->\n\nProse.\n")
    assert "old" not in filled
    assert fill(filled, lambda _: [table]) == filled


def test_a_study_without_rows_says_how_to_get_them():
    assert "make study-growth" in fill(PAGE, lambda _: [])


@pytest.mark.parametrize(
    "page", ["# None", PAGE.replace("<!-- end of rows -->", ""), PAGE + "<!-- rows of main -->\n"]
)
def test_marks_that_are_no_pair_are_refused(page):
    with pytest.raises(ValueError, match="in pairs"):
        fill(page, lambda _: [])


def test_a_mark_of_no_study_is_refused():
    with pytest.raises(ValueError, match="no study is called 'gains'; there are bases"):
        fill(PAGE.replace("growth", "gains"), lambda name: sum_up(name, Run(Place.default())))


def test_the_page_of_the_evidence_shows_the_rows_that_are_kept():
    page, run = (ROOT / "docs" / "evidence.md").read_text(), Run(Place.default())
    stale = fill(page, lambda name: sum_up(name, run)) != page
    assert not stale, "`make studies ARGS='--page docs/evidence.md'` writes them anew"
