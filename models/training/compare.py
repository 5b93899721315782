"""What the table of errors comes to: ratios to the paper's rows and to the peer's, in one look."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from models.metrics import FRAMES
from models.training.evaluate import PUBLISHED, Row

EARLY, LATE = (2, 4), (8, 10, 13, 15)
"""Frames of the table that are summed up apart: the first two are the hardest to improve."""
PAPER_BEFORE, PAPER_AFTER = "paper: base", "paper: personal"
PAIRS = (
    ("base", PAPER_BEFORE),
    ("personal", PAPER_AFTER),
    ("base", "simlpe"),
    ("personal", "simlpe_personal"),
)
"""What is summed up: ours, and what it is divided by."""
Cells = Mapping[tuple[str, str], Sequence[float]]
"""Errors in cm² at the frames of the table, by method and subject."""


@dataclass(frozen=True, slots=True)
class Cell:
    """One ratio of the table, and where it stands."""

    ratio: float
    subject: str
    frame: int


@dataclass(frozen=True, slots=True)
class Summary:
    """One method ÷ another, over the subjects for whom there are both.

    Attributes:
        method, reference: what is divided by what.
        subjects: whose cells they are.
        early: mean ratio of the cells of frames 2 and 4.
        late: mean ratio of the cells of frames 8 to 15.
        worst: the largest ratio of all.
    """

    method: str
    reference: str
    subjects: tuple[str, ...]
    early: float
    late: float
    worst: Cell

    def as_json(self) -> dict[str, Any]:
        """Give the summary as the command line writes it."""
        return asdict(self)


def gather_cells(rows: Sequence[Row], *, published: bool) -> dict[tuple[str, str], list[float]]:
    """Give the errors of the rows, and of the paper's for the same subjects if wanted."""
    found = {(row.method, row.subject): list(row.scores.mse_cm2) for row in rows}
    subjects = {row.subject for row in rows}
    paper = {key: list(values) for key, values in PUBLISHED.items() if key[1] in subjects}
    return found | paper if published else found


def divide(cells: Cells, method: str, reference: str, subject: str) -> list[float] | None:
    """Divide two rows of a subject frame by frame; None where one of them is missing."""
    above, below = cells.get((method, subject)), cells.get((reference, subject))
    if above is None or below is None:
        return None
    return [a / b for a, b in zip(above, below, strict=True)]


def summarise(cells: Cells) -> list[Summary]:
    """Sum up every pair for which there is a subject with both rows."""
    subjects = list(dict.fromkeys(subject for _, subject in cells))
    found = []
    for method, reference in PAIRS:
        rows = {who: divide(cells, method, reference, who) for who in subjects}
        ratios = [
            Cell(ratio, who, frame)
            for who, row in rows.items()
            if row is not None
            for ratio, frame in zip(row, FRAMES, strict=True)
        ]
        if ratios:
            found.append(_sum_up(method, reference, ratios))
    return found


def _sum_up(method: str, reference: str, ratios: Sequence[Cell]) -> Summary:
    return Summary(
        method=method,
        reference=reference,
        subjects=tuple(dict.fromkeys(cell.subject for cell in ratios)),
        early=_mean(ratios, EARLY),
        late=_mean(ratios, LATE),
        worst=max(ratios, key=lambda cell: cell.ratio),
    )


def _mean(ratios: Sequence[Cell], frames: Sequence[int]) -> float:
    chosen = [cell.ratio for cell in ratios if cell.frame in frames]
    return sum(chosen) / len(chosen)
