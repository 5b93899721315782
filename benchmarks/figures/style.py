"""How the figures look: colours that everybody tells apart, files that change with content only."""

from pathlib import Path

import matplotlib as mpl

mpl.use("agg")  # no screen
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

INK, SOFT, GRID = "#1b2733", "#5c6b7a", "#dfe5ea"
COLOURS = {
    "truth": INK,
    "zero_velocity": "#8a97a3",
    "paper": "#cc79a7",
    "base": "#d55e00",
    "served": "#0072b2",
    "plain": "#56b4e9",
}
"""By method; after Okabe and Ito, Color Universal Design, 2008."""
NAMES = {
    "truth": "what happened",
    "zero_velocity": "zero velocity",
    "paper": "paper",
    "base": "base",
    "served": "personal, as served",
    "plain": "personal, without judge and gate",
}

plt.rcParams.update(
    {
        "font.family": "DejaVu Sans",
        "font.size": 9,
        "axes.edgecolor": SOFT,
        "axes.labelcolor": INK,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.titlesize": 10,
        "axes.titleweight": "bold",
        "axes.grid": True,
        "axes.axisbelow": True,
        "grid.color": GRID,
        "xtick.color": SOFT,
        "ytick.color": SOFT,
        "legend.frameon": False,
        "svg.hashsalt": "kinecast",
        "svg.fonttype": "path",
        "figure.facecolor": "white",
        "figure.dpi": 110,
    }
)


def save(figure: Figure, path: Path) -> None:
    """Write a figure as SVG, the same bytes for the same content."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, metadata={"Date": None, "Creator": None}, bbox_inches="tight")
    plt.close(figure)
    tidied = "\n".join(line.rstrip() for line in path.read_text().splitlines())
    path.write_text(tidied + "\n")
