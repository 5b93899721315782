"""`make docs`: the pages as HTML."""

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from tests.conftest import ROOT
from tests.contract.pages import list_pages

CONFIGURATION = ROOT / "docs" / "site" / "mkdocs.yml"
BEYOND = ("docs/decisions/", "app/", "tests/", "benchmarks/", "migrations/", "docs/site/")
"""Pages that need not be in the menu: an index leads to them."""


def list_menu(entries: list | dict | str) -> list[str]:
    """The pages of MkDocs's `nav`, which nests lists and titles."""
    if isinstance(entries, str):
        return [entries]
    nested = entries.values() if isinstance(entries, dict) else entries
    return [page for entry in nested for page in list_menu(entry)]


def test_every_page_is_in_the_menu_of_the_site_once() -> None:
    configuration = yaml.load(CONFIGURATION.read_text(), yaml.BaseLoader)  # noqa: S506 - strings only
    menu = list_menu(configuration["nav"])
    names = [str(page.relative_to(ROOT)) for page in list_pages()]
    assert [page for page in menu if not (ROOT / page).exists()] == []
    assert [name for name in names if name not in menu and not name.startswith(BEYOND)] == []
    assert len(menu) == len(set(menu))


@pytest.mark.skipif(
    importlib.util.find_spec("mkdocs") is None or importlib.util.find_spec("material") is None,
    reason="MkDocs is not installed: pip install -e '.[docs]'",
)
def test_site_is_built_without_a_warning_and_fetches_nothing_from_elsewhere(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, ROOT / "docs" / "site" / "build.py", tmp_path],
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    pages = list((tmp_path / "site").rglob("*.html"))
    assert len(pages) > 15
    for page in pages:
        text = page.read_text()
        assert re.findall(r"<(?:script|link|img)[^>]*(?:src|href)=\"?https?:[^>]*>", text) == []
        assert "arithmatex" not in text  # formulas became MathML
