"""Draw the figures of docs/figures that show how good forecasts are: `make figures`.

Most need only the rows that the studies keep; two need recordings, and one of these a fit for each
test subject, kept in build/. A figure whose rows are missing is left as it is, and said so.
"""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

from matplotlib.figure import Figure

from benchmarks.figures.latent import draw_latent
from benchmarks.figures.people import draw_poses
from benchmarks.figures.rows import MissingError
from benchmarks.figures.style import save
from benchmarks.figures.tables import draw_actions, draw_horizon, draw_seconds, draw_table

FIGURES: dict[str, Callable[[], Figure]] = {
    "table": draw_table,
    "horizon": draw_horizon,
    "actions": draw_actions,
    "seconds": draw_seconds,
    "poses": draw_poses,
    "latent": draw_latent,
}


def main() -> None:
    """Draw what was asked for; fails if any of it could not be drawn."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", choices=[*FIGURES, []], help="all unless told")
    parser.add_argument("--folder", type=Path, default=Path("docs/figures"))
    arguments = parser.parse_args()
    drawn = [_draw(name, arguments.folder) for name in arguments.names or FIGURES]
    sys.exit(0 if all(drawn) else 1)


def _draw(name: str, folder: Path) -> bool:
    path = folder / f"{name}.svg"
    try:
        figure = FIGURES[name]()
    except MissingError as error:
        print(f"{path}: not drawn, nothing was measured; first `{error}`")
        return False
    save(figure, path)
    print(path)
    return True


if __name__ == "__main__":
    main()
