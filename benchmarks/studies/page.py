"""The tables of a page of the documentation, written between marks from the rows of the studies."""

import re
from collections.abc import Callable, Sequence

from benchmarks.studies.tables import Table

MARKS = re.compile(
    r"(?P<head><!-- rows of (?P<study>[a-z]+) -->\n).*?(?P<foot><!-- end of rows -->)", re.DOTALL
)
"""What stands between them is written by `fill`; a comment is not shown on the built page."""


def fill(page: str, tables: Callable[[str], Sequence[Table]]) -> str:
    """Write the tables of a page anew, and leave the rest of it as it is.

    Args:
        page: Markdown with pairs of marks, such as `<!-- rows of growth -->` and
            `<!-- end of rows -->`.
        tables: gives those of the study that a mark names.

    Raises:
        ValueError: it has no such marks, or one that is not of a pair.
    """
    begun, ended = page.count("<!-- rows of "), page.count("<!-- end of rows -->")
    if not begun or begun != ended or begun != len(MARKS.findall(page)):
        raise ValueError(
            f"{begun} marks '<!-- rows of STUDY -->' and {ended} '<!-- end of rows -->':"
            " they have to come in pairs, at least one"
        )
    return MARKS.sub(lambda mark: _write(mark, tables(mark["study"])), page)


def _write(mark: re.Match[str], tables: Sequence[Table]) -> str:
    study = mark["study"]
    told = [table.as_markdown() for table in tables]
    body = "\n".join(told or [f"No rows yet: run `make study-{study}`.\n"])
    return f"{mark['head']}\n{body}\n{mark['foot']}"
