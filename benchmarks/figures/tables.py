"""Figures from the rows of the studies alone: the table, the horizon, actions, seconds."""

from collections.abc import Sequence

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.figures.rows import read_corrections, read_fits, read_seeds
from benchmarks.figures.style import COLOURS, INK, NAMES
from benchmarks.studies.main import PAPER_ROWS, SHIPPED, Seeds
from models.data.splits import TEST_SUBJECTS
from models.metrics import FRAMES
from models.spec import MotionSpec
from models.training.evaluate import PUBLISHED

_SECONDS = (1, 2, 5, 10, 20, 60)
_STEP_MS = 1000 / MotionSpec().rate_hz


def draw_table() -> Figure:
    """Draw ours ÷ the paper's row, before and after personalisation, mean over seeds."""
    seeds = read_seeds(SHIPPED)
    methods = ("base", "served")
    figure, axes = plt.subplots(1, 2, figsize=(9, 2.6), layout="constrained")
    for axis, method in zip(axes, methods, strict=True):
        ratios = np.array([_divide(seeds, method, subject) for subject in TEST_SUBJECTS])
        axis.imshow(ratios, cmap="RdBu_r", vmin=0.2, vmax=1.8, aspect="auto")
        for (row, column), ratio in np.ndenumerate(ratios):
            axis.text(column, row, f"{ratio:.2f}", ha="center", va="center", color=INK)
        axis.set_xticks(range(len(FRAMES)), [f"{frame * _STEP_MS:.0f} ms" for frame in FRAMES])
        axis.set_yticks(range(len(TEST_SUBJECTS)), [f"subject {one}" for one in TEST_SUBJECTS])
        axis.set_title(f"{NAMES[method]}: mean {ratios.mean():.2f}")
        axis.grid(visible=False)
    figure.suptitle(f"Squared error ÷ the paper's, {_count(seeds)}; below 1 is better", x=0.5)
    return figure


def draw_horizon() -> Figure:
    """Draw error against horizon, with the range over seeds, beside the paper's rows."""
    seeds = read_seeds(SHIPPED)
    figure, axes = plt.subplots(1, 3, figsize=(11, 3.4), sharey=True, layout="constrained")
    times = [frame * _STEP_MS for frame in FRAMES]
    for axis, subject in zip(axes, TEST_SUBJECTS, strict=True):
        for method in ("zero_velocity", "base", "served"):
            errors = np.array([one[subject].cm2(method) for one in seeds.values()])
            colour = COLOURS[method]
            axis.plot(times, errors.mean(axis=0), color=colour, marker="o", ms=3)
            axis.fill_between(
                times, errors.min(axis=0), errors.max(axis=0), color=colour, alpha=0.2
            )
            _label(axis, times[-1], errors.mean(axis=0)[-1], NAMES[method].split(",")[0], colour)
        for row, style in (("paper: base", "--"), ("paper: personal", ":")):
            axis.plot(times, PUBLISHED[row, subject], style, color=COLOURS["paper"])
            _label(axis, times[-1], PUBLISHED[row, subject][-1], row, COLOURS["paper"])
        axis.set(title=f"subject {subject}", xlabel="horizon, ms", xlim=(40, 700))
        axis.set_xticks(range(100, 600, 100))
    axes[0].set_ylabel("mean squared error over frames 1..k, cm²")
    figure.suptitle(f"Error against horizon, trials 2 to 4, {_count(seeds)}")
    return figure


def draw_actions() -> Figure:
    """Draw who gains and who loses by a version, action by action, at 500 ms."""
    seeds = read_seeds(SHIPPED)
    figure, axes = plt.subplots(1, 3, figsize=(11, 5.4), sharex=True, layout="constrained")
    for axis, subject in zip(axes, TEST_SUBJECTS, strict=True):
        found = [one[subject] for one in seeds.values()]
        actions = sorted(set(found[0].actions), key=int)
        changes = {
            action: float(
                np.mean([one.pick_action(action).ratio("served", "base") - 1 for one in found])
            )
            for action in actions
        }
        ordered = sorted(changes, key=lambda action: changes[action])
        values = [100 * changes[action] for action in ordered]
        colours = [COLOURS["served"] if value <= 0 else COLOURS["base"] for value in values]
        axis.barh(range(len(values)), values, color=colours)
        axis.set_yticks(range(len(values)), ordered, fontsize=7)
        axis.axvline(0, color=INK, lw=0.8)
        better = sum(value < 0 for value in values)
        axis.set(title=f"subject {subject}: {better} of {len(values)} better")
        axis.set_xlabel("change of squared error at 500 ms, %")
    axes[0].set_ylabel("action of UTD-MHAD")
    figure.suptitle(f"Personal version against base, by action, {_count(seeds)}")
    return figure


def draw_seconds() -> Figure:
    """Draw error against the seconds that a fit may take: versions, plain fits, closed form."""
    curves = {
        ("version, gated and corrected", "-"): read_fits("gated"),
        ("fitted, all of the way", "--"): read_fits("plain"),
    }
    closed = read_corrections()
    subjects = sorted({subject for fits in curves.values() for subject, *_ in fits})
    size = (1 + 2.6 * len(subjects), 3.4)
    figure, axes = plt.subplots(1, len(subjects), figsize=size, sharey=True, layout="constrained")
    for axis, subject in zip(np.atleast_1d(axes), subjects, strict=True):
        for (label, style), fits in curves.items():
            axis.plot(
                *_pick(fits, subject), style, marker="o", ms=3, c=COLOURS["served"], label=label
            )
        axis.plot(*_pick(closed, subject), "D", ms=5, c=COLOURS["base"], label="closed form alone")
        axis.set(xscale="log", title=f"subject {subject}", xlabel="seconds of one core")
        axis.set_xticks(_SECONDS, [f"{one}" for one in _SECONDS])
        axis.minorticks_off()
    np.atleast_1d(axes)[0].set_ylabel("squared error at 500 ms ÷ base")
    np.atleast_1d(axes)[-1].legend(fontsize=7)
    figure.suptitle("What a second of fitting is worth")
    return figure


def _pick(
    points: Sequence[tuple[str, float, float]], subject: str
) -> tuple[list[float], list[float]]:
    own = [(spent, ratio) for who, spent, ratio in points if who == subject]
    return [spent for spent, _ in own], [ratio for _, ratio in own]


def _divide(seeds: Seeds, method: str, subject: str) -> np.ndarray:
    errors = np.mean([one[subject].cm2(method) for one in seeds.values()], axis=0)
    ratios: np.ndarray = errors / np.array(PUBLISHED[PAPER_ROWS[method], subject])
    return ratios


def _count(seeds: Seeds) -> str:
    return "one seed" if len(seeds) == 1 else f"{len(seeds)} seeds"


def _label(axis: Axes, x: float, y: float, text: str, colour: str) -> None:
    axis.annotate(
        text, (x, y), (4, 0), textcoords="offset points", color=colour, va="center", fontsize=7
    )
