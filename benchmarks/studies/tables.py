"""Summaries as tables: for a terminal, and as Markdown for the documentation."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from rich import box
from rich.console import Console
from rich.table import Table as RichTable

from models.metrics import FRAMES, Ratio


@dataclass(frozen=True, slots=True)
class Table:
    """A table of strings.

    Attributes:
        title: what it says.
        columns: its head.
        rows: as many cells each.
    """

    title: str
    columns: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]

    def as_markdown(self) -> str:
        """Write the table as Markdown, with its title above."""
        lines = [self.columns, tuple("---" for _ in self.columns), *self.rows]
        body = "\n".join(f"| {' | '.join(line)} |" for line in lines)
        return f"{self.title}\n\n{body}\n"

    def show(self, console: Console) -> None:
        """Print the table."""
        made = RichTable(title=self.title, title_justify="left", box=box.SIMPLE, pad_edge=False)
        for place, column in enumerate(self.columns):
            made.add_column(column, justify="right" if place else "left", no_wrap=not place)
        for row in self.rows:
            made.add_row(*row)
        console.print(made)


FRAME_COLUMNS = tuple(f"{frame}" for frame in FRAMES)
RATIO_COLUMNS = (*FRAME_COLUMNS, f"95 % at {FRAMES[-1]}")


def cells(values: Sequence[float], digits: int = 2) -> tuple[str, ...]:
    """Write numbers."""
    return tuple(f"{value:.{digits}f}" for value in values)


def tell_ratio(ratio: Ratio) -> str:
    """Write a ratio with its interval."""
    return f"{ratio.value:.3f} ({ratio.low:.3f} to {ratio.high:.3f})"


def tell_ratios(ratios: Mapping[int, Ratio]) -> tuple[str, ...]:
    """Write a ratio at every frame, and the interval of the last one."""
    last = ratios[FRAMES[-1]]
    values = tuple(f"{ratio.value:.3f}" for ratio in ratios.values())
    return (*values, f"{last.low:.3f} to {last.high:.3f}")


def tell_spread(values: Sequence[float], digits: int = 3) -> str:
    """Write the mean of a few values and the range that they span."""
    mean = sum(values) / len(values)
    if len(values) == 1:
        return f"{mean:.{digits}f}"
    return f"{mean:.{digits}f} ({min(values):.{digits}f} to {max(values):.{digits}f})"


def percent(part: int, whole: int) -> str:
    """Write a share with its count."""
    return f"{part} of {whole} ({part / whole:.1%})" if whole else "-"
