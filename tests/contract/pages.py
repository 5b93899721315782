"""Reading the pages of the documentation."""

import re
import shlex
from pathlib import Path

from markdown_it import MarkdownIt
from markdown_it.token import Token

from tests.conftest import ROOT

FOLDERS = ("app", "benchmarks", "clients", "docs", "migrations", "models", "tests")
"""Where pages may lie, beside the root."""


def list_pages() -> list[Path]:
    """Every page of the repository."""
    nested = [page for folder in FOLDERS for page in (ROOT / folder).rglob("*.md")]
    return sorted([*ROOT.glob("*.md"), *nested])


def read_page(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def read_section(name: str, heading: str) -> str:
    """What stands under a heading, up to the next one of its level or above."""
    text = read_page(name)
    level = len(heading) - len(heading.lstrip("#"))
    begin = text.index(f"\n{heading}\n") + len(heading) + 2
    end = re.compile(rf"^#{{1,{level}}} ", re.MULTILINE).search(text, begin)
    return text[begin : end.start() if end else None]


def read_blocks(text: str, language: str) -> list[str]:
    """The fenced blocks of a language."""
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


def read_rows(text: str, first: str) -> list[list[str]]:
    """The rows of the table whose heading begins with a cell, as plain cells."""
    lines = iter(text.splitlines())
    for line in lines:
        if line.startswith(f"| {first} |"):
            break
    else:
        raise LookupError(f"there is no table that begins with {first!r}")
    next(lines)
    rows = []
    for line in lines:
        if not line.startswith("|"):
            break
        rows.append([cell.strip() for cell in line.strip("|").split("|")])
    return rows


def quoted(text: str) -> set[str]:
    """Everything in backticks."""
    return set(re.findall(r"`([^`\n]+)`", text))


def list_commands(text: str) -> list[list[str]]:
    """The arguments of each `kinecast …` in shell blocks and in backticks, without placeholders."""
    shell = "\n".join(read_blocks(text, "sh") + read_blocks(text, "bash")).replace("\\\n", " ")
    found = []
    for line in [*shell.splitlines(), *sorted(quoted(text))]:
        if called := re.search(r"(?:^|[\s(/])kinecast ((?:[a-z-]+|--[a-z]+)\b.*)", line):
            end = re.split(r"\s(?:\||&&|&|>|2>|;)|\)\s*$|;", called[1])[0]
            words = shlex.split(end, comments=True)
            found.append([word for word in words if not re.search(r"[…$\[\]]", word)])
    return found


def list_links(text: str) -> list[str]:
    """Where the links and the pictures of a page lead, as CommonMark reads it."""
    return [target for token in MarkdownIt().parse(text) for target in _find_targets(token)]


def _find_targets(token: Token) -> list[str]:
    own = [str(token.attrs[name]) for name in ("href", "src") if name in token.attrs]
    if token.type in {"html_inline", "html_block"}:
        own += re.findall(r"""(?:href|src)=["']([^"']+)["']""", token.content)
    return own + [target for child in token.children or () for target in _find_targets(child)]


def slugs(text: str) -> set[str]:
    """The anchors of a page's headings, as they are shown on the web."""
    headings = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {
        re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings
    }
