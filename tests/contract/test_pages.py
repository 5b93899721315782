"""Every page: its links, the paths and commands that it names, and the README's tree."""

import importlib.util
import re
from pathlib import Path

import pytest
from typer.main import get_command

from app.cli import LAZY, app, load_command
from tests.conftest import ROOT
from tests.contract.pages import (
    list_commands,
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


@pytest.mark.parametrize("name", NAMES)
def test_every_command_that_a_page_names_can_be_parsed(name):
    for words in list_commands(read_page(name)):
        assert explain_command(words) == "", f"kinecast {' '.join(words)}"


def test_commands_are_found_in_blocks_and_in_backticks():
    page = """
Run `kinecast keys create --name "robot 7"`, or `kinecast walk`; kinecast is its name.

```sh
kinecast evaluate --data mine.npz \\
  --subjects p1 | tee log    # everybody
export KEY=$(kinecast keys create --scope predict)
.venv/bin/kinecast calibrate $D --data [FILE] --fold …
```

```python
kinecast = 3
```
"""
    assert list_commands(page) == [
        ["evaluate", "--data", "mine.npz", "--subjects", "p1"],
        ["keys", "create", "--scope", "predict"],
        ["calibrate", "--data", "--fold"],
        *sorted([["keys", "create", "--name", "robot 7"], ["walk"]]),
    ]


def explain_command(words):
    """Say what is wrong with the arguments of a command; nothing where it would run."""
    lazy = {one.name: load_command(one) for one in LAZY if one.name == words[0]}
    command = get_command(next(iter(lazy.values()), app))
    words = words[1:] if lazy else words
    while hasattr(command, "commands") and words and not words[0].startswith("-"):
        if words[0] not in command.commands:
            return f"no command {words[0]}"
        command, words = command.commands[words[0]], words[1:]
    parser = command.make_parser(command.context_class(command, info_name="kinecast"))
    try:
        _, left, _ = parser.parse_args(list(words))
    except Exception as error:  # noqa: BLE001 - Typer's own classes are private
        return str(error)
    return f"too much: {left}" if left else ""


@pytest.mark.parametrize(
    ("line", "wrong"),
    [
        ("keys create --name robot --scope predict", ""),
        ("keys create robot --scope predict", "too much"),
        ("keys make", "no command make"),
        ("evaluate --dta here", "No such option: --dta"),
        ("evaluate --data", "requires an argument"),
        ("bench streams", "no command streams"),
        ("walk", "no command walk"),
    ],
)
def test_wrong_commands_would_be_seen(line, wrong):
    found = explain_command(line.split())
    assert wrong in found
    assert bool(wrong) == bool(found)


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
