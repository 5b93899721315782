"""Every page: its links, the paths and commands that it names, and the README's tree."""

import importlib.util
import re
from pathlib import Path

import pytest
from typer.main import get_command

from app.cli import LAZY, app, load_command
from tests.conftest import ROOT
from tests.contract.pages import (
    list_links,
    list_pages,
    read_blocks,
    read_page,
    read_section,
    slugs,
)

PAGES = list_pages()
NAMES = [str(page.relative_to(ROOT)) for page in PAGES]
PATH = re.compile(
    r"(?<![\w./-])((?:app|models|docs|tests|migrations|benchmarks|clients|\.ci)/[\w./-]*[\w/])"
)


def strip_blocks(text: str) -> str:
    return re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("name", NAMES)
def test_every_link_leads_somewhere(name):
    page = ROOT / name
    dead = []
    for target in list_links(page.read_text()):
        if re.match(r"[a-z]+:", target):
            continue
        file, _, anchor = target.partition("#")
        path = (page.parent / file).resolve() if file else page
        if not path.exists() or (anchor and anchor not in slugs(path.read_text())):
            dead.append(target)
    assert dead == []


@pytest.mark.parametrize("name", NAMES)
def test_every_path_that_a_page_names_exists(name):
    text = read_page(name)
    missing = {path for path in PATH.findall(text) if not (ROOT / path).exists()}
    assert missing == set()


@pytest.mark.parametrize("name", NAMES)
def test_every_module_that_a_page_imports_exists(name):
    modules = re.findall(r"(?:from|import) ((?:app|models)(?:\.\w+)+)", read_page(name))
    for module in modules:
        assert importlib.util.find_spec(module) is not None, module


def name_commands() -> set[str]:
    """Every command as it is typed, groups by their commands."""
    lazily = {lazy.name: load_command(lazy) for lazy in LAZY}
    found = set()
    for name, command in get_command(app).commands.items():
        group = get_command(lazily[name]) if name in lazily else command
        found |= {f"{name} {sub}" for sub in getattr(group, "commands", {})} or {name}
    return found


def test_every_command_is_in_the_pages():
    text = "\n".join(map(read_page, NAMES))
    assert {command for command in name_commands() if f"kinecast {command}" not in text} == set()


def test_every_command_that_a_page_names_exists():
    commands = name_commands()
    words = {command.split()[0] for command in commands}
    wrong = []
    for name in NAMES:
        for line in re.findall(r"(?:^|[`(/ ])kinecast ([a-z][^`\n]*)", quote_only(read_page(name))):
            first, *rest = line.split()
            if first not in words or (
                first not in commands and (not rest or f"{first} {rest[0]}" not in commands)
            ):
                wrong.append((name, line))
    assert wrong == []


def quote_only(text: str) -> str:
    """The code of a page: what is in backticks and in shell blocks, one piece a line."""
    pieces = re.findall(r"`([^`\n]+)`", strip_blocks(text))
    return "\n".join([*pieces, *read_blocks(text, "sh")])


def read_tree() -> list[Path]:
    """The paths of the README's tree."""
    (block,) = read_blocks(read_section("README.md", "## The tree"), "")
    paths, folders = [], {}
    for line in filter(str.strip, block.splitlines()):
        indent = len(line) - len(line.lstrip())
        name = line.split()[0]
        folders = {depth: path for depth, path in folders.items() if depth < indent}
        parent = folders[max(folders)] if folders else Path()
        paths.append(parent / name)
        if name.endswith("/"):
            folders[indent] = parent / name
    return paths


def test_everything_in_the_tree_exists_and_stands_there_once():
    tree = read_tree()
    assert [str(path) for path in tree if not (ROOT / path).exists()] == []
    assert len(tree) == len(set(tree)) > 50


def test_every_module_is_in_the_tree():
    tree = set(read_tree())
    modules = [
        path.relative_to(ROOT)
        for folder in ("app", "models", "benchmarks")
        for path in (ROOT / folder).rglob("*.py")
        if path.name != "__init__.py"
    ]
    assert sorted(str(path) for path in modules if path not in tree) == []


def test_every_page_of_the_docs_is_in_the_list_of_the_readme():
    section = read_section("README.md", "## Documentation")
    listed = set(re.findall(r"\]\(([^)]+)\)", section))
    pages = {name for name in NAMES if name.startswith("docs/") and "decisions" not in name}
    assert pages - listed == set()


def test_every_decision_is_in_the_index_and_has_its_three_parts():
    folder = ROOT / "docs" / "decisions"
    pages = sorted(page.name for page in folder.glob("[0-9]*.md"))
    index = (folder / "README.md").read_text()
    assert re.findall(r"\]\(([^)]+)\)", index) == pages
    for number, name in enumerate(pages, start=1):
        text = (folder / name).read_text()
        assert text.startswith(f"# {number:04}: ")
        assert re.findall(r"^## (.+)$", text, re.MULTILINE) == [
            "Context",
            "Decision",
            "Consequences",
        ]
