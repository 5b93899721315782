"""The tables that `kinecast evaluate` prints."""

from collections.abc import Sequence

from rich import box
from rich.table import Table

from app.commands.output import out
from models.metrics import FRAMES
from models.training.compare import (
    PAPER_AFTER,
    PAPER_BEFORE,
    Cells,
    Summary,
    divide,
    gather_cells,
    summarise,
)
from models.training.evaluate import PUBLISHED, Row

_BEFORE = ("zero_velocity", "damped_velocity", "ridge", "simlpe", "base", PAPER_BEFORE)
_SCREEN = 100
_AFTER = ("ridge_personal", "simlpe_personal", "personal", PAPER_AFTER)


def show_measures(rows: Sequence[Row], *, published: bool) -> None:
    """Print three tables that fit 80 columns: the protocol's, the errors at a frame, the mm."""
    out.print(
        _measure("mse_cm2", "cm², mean over frames 1..k (the protocol)", rows, published=published)
    )
    out.print(_measure("mse_cm2_at", "cm², at frame k", rows))
    out.print(_measure("mpjpe_mm", "mean distance per joint in mm, at frame k", rows))


def show_comparison(rows: Sequence[Row], *, published: bool) -> None:
    """Print one table that fits 100 columns, and what it comes to in a line per comparison."""
    cells = gather_cells(rows, published=published)
    table = Table(box=box.SIMPLE, padding=0)
    table.title = "cm², mean over frames 1..k (the protocol)"
    table.title += "; on the right ÷ the paper's row of the same kind" if published else ""
    table.title_justify = "left"
    table.add_column("subject, method", no_wrap=True)
    for sign in ("", "÷") if published else ("",):
        for frame in FRAMES:
            table.add_column(f"{sign}{frame}", justify="right", no_wrap=True)
    for subject in dict.fromkeys(row.subject for row in rows):
        for method in (*_BEFORE, *_AFTER):
            if (method, subject) in cells:
                ratios = _ratios(cells, method, subject) if published else []
                values = [f"{value:.2f}" for value in cells[method, subject]]
                style = "dim" if method.startswith("paper") else None
                table.add_row(f"{subject}  {method}", *values, *ratios, style=style)
        table.add_section()
    _print_wide(table)
    summaries = summarise(cells)
    if summaries:
        _print_wide(_sum_up(summaries))


def show_coverage(rows: Sequence[Row]) -> None:
    """Print how often truth was within the radius, a line per row that knows it."""
    for row in rows:
        if row.coverage is not None:
            told = ", ".join(f"{p:.0%}: {q:.1%}" for p, q in row.coverage.items())
            out.print(f"coverage of the radius, {row.method}, subject {row.subject}: {told}")


def _ratios(cells: Cells, method: str, subject: str) -> list[str]:
    reference = PAPER_AFTER if method in _AFTER else PAPER_BEFORE
    found = None if method == reference else divide(cells, method, reference, subject)
    return [f"{ratio:.2f}" for ratio in found or ()]


def _print_wide(table: Table) -> None:
    """Print a table in its own width, also where nobody knows how wide the screen is."""
    table.width = out.measure(table, options=out.options.update(width=_SCREEN)).maximum
    out.print(table)


def _sum_up(summaries: Sequence[Summary]) -> Table:
    table = Table(box=box.SIMPLE, pad_edge=False)
    for name in ("ours ÷ theirs, mean of cells", "frames 8-15", "frames 2, 4", "worst cell"):
        table.add_column(name, no_wrap=True)
    for found in summaries:
        worst = found.worst
        place = f"{worst.ratio:.3f} (subject {worst.subject}, frame {worst.frame})"
        name = f"{found.method} ÷ {found.reference}"
        table.add_row(name, f"{found.late:.3f}", f"{found.early:.3f}", place)
    return table


def _measure(measure: str, title: str, rows: Sequence[Row], *, published: bool = False) -> Table:
    table = Table(title=title, title_justify="left", box=box.SIMPLE, pad_edge=False)
    table.add_column("subject, method", no_wrap=True)
    for frame in FRAMES:
        table.add_column(f"{frame}\n{frame * 1000 / 30:.0f} ms", justify="right", no_wrap=True)
    for subject in dict.fromkeys(row.subject for row in rows):
        for row in rows:
            if row.subject == subject:
                cells = [f"{value:.2f}" for value in getattr(row.scores, measure)]
                table.add_row(f"{subject}  {row.method}", *cells)
        for (name, whose), values in PUBLISHED.items():
            if published and whose == subject:
                table.add_row(f"{subject}  {name}", *(f"{v:.2f}" for v in values), style="dim")
        table.add_section()
    return table
