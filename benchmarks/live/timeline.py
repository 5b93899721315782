"""Draws a take: what the service was doing, how good its forecasts were, and how fast."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64

from benchmarks.live.story import MEAN_S, Errors, Stage, Swap, smooth
from benchmarks.live.svg import INK, QUIET, Canvas, Point
from benchmarks.live.take import RATE_HZ

WIDTH, HEIGHT = 960.0, 560.0
LEFT, RIGHT = 64.0, 944.0
BAND_TOP, BAND_HEIGHT = 86.0, 26.0
BELOW = BAND_TOP + BAND_HEIGHT + 16
ERROR_TOP, ERROR_BOTTOM = 176.0, 366.0
LATE_TOP, LATE_BOTTOM = 404.0, 494.0
PANELS = (
    (BAND_TOP - 6, BAND_TOP + BAND_HEIGHT + 4),
    (ERROR_TOP, ERROR_BOTTOM),
    (LATE_TOP, LATE_BOTTOM),
)
DEADLINE_MS = 1e3 / RATE_HZ
STEP_S = 0.25
LEVELS = (1, 3, 10, 30, 100, 300, 1000, 3000)
SERVED, BASE, STILL, GRID = "#0072b2", "#d55e00", "#9aa3ad", "#e3e7ec"
LOOKS = {
    "recording": ("#9ecae8", ("recording trial 1",)),
    "queued": ("#c9ced6", ("queued",)),
    "checking": ("#c9ced6", ("checking",)),
    "fitting": ("#e8a33d", ("fitting on all", "fitting")),
    "answering": ("#8fd0b6", ("version 1 answers", "version 1")),
}
JUDGING = ("#f7dfa6", "#f0cb78")
"""Colours of the folds in turn."""
CHARACTER = 6.6
"""About the width of a letter of the labels."""


@dataclass(frozen=True, eq=False)
class Timeline:
    """What is drawn; everything in it was measured in one run.

    Attributes:
        report: the figures for the captions.
        stages: what was going on.
        swap: how the version came to answer.
        errors: of forecasts whose truth has come.
        came: when each forecast came.
        late_ms: how long after its frame was due.
    """

    report: dict[str, Any]
    stages: Sequence[Stage]
    swap: Swap
    errors: Errors
    came: Float64[np.ndarray, " forecast"]
    late_ms: Float64[np.ndarray, " forecast"]


@dataclass(frozen=True, slots=True)
class _Scale:
    """Values to pixels."""

    low: float
    high: float
    begin: float
    end: float
    is_log: bool = False

    def __call__(self, value: float) -> float:
        low, high, at = self.low, self.high, min(max(value, self.low), self.high)
        if self.is_log:
            low, high, at = math.log(low), math.log(high), math.log(at)
        return self.begin + (at - low) / (high - low) * (self.end - self.begin)


def draw(timeline: Timeline) -> str:
    """Draw a run as SVG."""
    report = timeline.report
    canvas = Canvas(WIDTH, HEIGHT, title="From the first recorded frame to a personal forecast")
    x = _Scale(0.0, float(report["seconds"]), LEFT, RIGHT)
    canvas.text(16, 30, "From the first recorded frame to a personal forecast", size=18, bold=True)
    canvas.text(16, 51, _describe(report), size=12.5, fill=QUIET)
    _draw_time(canvas, x)
    _draw_stages(canvas, timeline.stages, x)
    _draw_errors(canvas, timeline, x)
    _draw_latency(canvas, timeline, x)
    _draw_swap(canvas, timeline, x)
    canvas.text(16, HEIGHT - 12, _explain(report), size=11.5, fill=QUIET)
    return str(canvas)


def _describe(report: dict[str, Any]) -> str:
    return (
        f"UTD-MHAD subject {report['subject']} on one WebSocket stream at 30 Hz: trial 1 is "
        f"recorded ({report['stored']['clips']} clips, {report['recorded_s']:.0f} s of motion), "
        "then trial 2 is shown"
    )


def _explain(report: dict[str, Any]) -> str:
    frames, latency = report["frames"], report["latency"]
    machine, tails = report["machine"], "/".join(f"{latency[n]['p99_ms']:.0f}" for n in latency)
    return (
        f"One run of {report['seconds']:.0f} s; {machine['cores']} cores, load "
        f"{machine['load_before']:.1f} before it. "
        f"{frames['sent']} frames, {frames['answered']} forecasts, {frames['skipped']} skipped, "
        f"{frames['missing']} lost. p99 latency before/during/after training: {tails} ms."
    )


def _draw_time(canvas: Canvas, x: _Scale) -> None:
    step = next(s for s in (5, 10, 20, 30, 60, 120, 300) if x.high / s <= 12)
    for second in range(0, int(x.high) + 1, step):
        at = x(second)
        for top, bottom in PANELS[1:]:
            canvas.line([(at, top), (at, bottom)], stroke=GRID)
        canvas.text(at, LATE_BOTTOM + 17, str(second), fill=QUIET, anchor="middle")
    canvas.text(RIGHT, LATE_BOTTOM + 34, "seconds since trial.start", fill=QUIET, anchor="end")


def _draw_stages(canvas: Canvas, stages: Sequence[Stage], x: _Scale) -> None:
    """Draw a bar for each stage, its length below; names that do not fit stand there too."""
    narrow: list[str] = []
    for number, stage in enumerate(stages):
        colour, names = _find_looks(stage.kind, number)
        begin, end = x(stage.begin), x(stage.end)
        canvas.rect(begin, BAND_TOP, end - begin, BAND_HEIGHT, fill=colour)
        name = next((one for one in names if len(one) * CHARACTER <= end - begin - 8), None)
        if name is None:
            narrow.append(f"{names[0]} {_tell_seconds(stage)}")
            continue
        canvas.text(begin + 5, BAND_TOP + 17, name, size=11.5)
        canvas.text(begin + 5, BELOW, _tell_seconds(stage), size=11.5, fill=QUIET)
        if narrow:
            canvas.text(begin - 5, BELOW, ", ".join(narrow), size=11.5, fill=QUIET, anchor="end")
            narrow.clear()


def _find_looks(kind: str, number: int) -> tuple[str, tuple[str, ...]]:
    """Give the colour of a stage, and names for it, the longest first."""
    if kind.startswith("judging"):
        fold = kind.rsplit(maxsplit=1)[-1]
        return JUDGING[number % 2], (f"judging, fold {fold}", f"judging {fold}", f"fold {fold}")
    return LOOKS[kind]


def _tell_seconds(stage: Stage) -> str:
    return f"{stage.seconds:.0f} s" if stage.seconds >= 1 else f"{stage.seconds:.1f} s"


def _draw_errors(canvas: Canvas, timeline: Timeline, x: _Scale) -> None:
    errors = timeline.errors
    curves = {
        name: smooth(errors.at, getattr(errors, name), step_s=STEP_S)
        for name in ("still", "base", "served")
    }
    drawn = np.concatenate([values for _, values in curves.values()])
    lowest, highest = float(np.nanmin(drawn)), float(np.nanmax(drawn))
    y = _Scale(lowest / 1.8, highest * 1.1, ERROR_BOTTOM, ERROR_TOP, is_log=True)
    _draw_levels(canvas, y, [level for level in LEVELS if y.low <= level <= y.high])
    _fill_gain(canvas, curves["base"], curves["served"], x, y)
    looks = {"still": (STILL, 1.4), "base": (BASE, 1.8), "served": (SERVED, 2.1)}
    for name, (colour, width) in looks.items():
        for part in _split(*curves[name]):
            points = [(x(t), y(v)) for t, v in part]
            canvas.line(points, stroke=colour, width=width)
    _head(canvas, ERROR_TOP, f"squared error 500 ms ahead, cm² (means over {MEAN_S:g} s)")
    after = timeline.report["error_500_ms"]["after"]
    told = {
        "standing still": (STILL, "still"),
        "base": (BASE, "base"),
        "served": (SERVED, "served"),
    }
    keys = [(f"{name} {after[f'{key}_cm2']:.0f}", colour) for name, (colour, key) in told.items()]
    right = _draw_keys(canvas, keys)
    canvas.text(right, ERROR_TOP - 9, "means after the swap:", fill=QUIET, anchor="end")


def _fill_gain(
    canvas: Canvas,
    base: tuple[np.ndarray, np.ndarray],
    served: tuple[np.ndarray, np.ndarray],
    x: _Scale,
    y: _Scale,
) -> None:
    """Tint what lies between the base and what was served."""
    both = np.where(np.isfinite(base[1]), served[1], np.nan)
    for part in _split(base[0], both):
        times = [t for t, _ in part]
        upper = [(x(t), y(base[1][np.searchsorted(base[0], t)])) for t in times]
        lower = [(x(t), y(v)) for t, v in part]
        canvas.area([*upper, *reversed(lower)], fill="#d9ecf7")


def _draw_keys(canvas: Canvas, keys: Sequence[tuple[str, str]]) -> float:
    """Draw the key from the right; gives where it begins."""
    right = RIGHT
    for words, colour in keys:
        right -= len(words) * CHARACTER
        canvas.text(right, ERROR_TOP - 9, words, fill=INK)
        canvas.line(
            [(right - 28, ERROR_TOP - 13), (right - 6, ERROR_TOP - 13)],
            stroke=colour,
            width=2.4,
        )
        right -= 42
    return right + 6


def _draw_latency(canvas: Canvas, timeline: Timeline, x: _Scale) -> None:
    highest = 1.2 * max(100.0, float(timeline.late_ms.max()))
    y = _Scale(3.0, highest, LATE_BOTTOM, LATE_TOP, is_log=True)
    _draw_levels(canvas, y, [level for level in (3, 10, 100, 1000) if level <= highest])
    points = list(zip(timeline.came.tolist(), timeline.late_ms.tolist(), strict=True))
    canvas.dots([(x(t), y(ms)) for t, ms in points], fill=SERVED, size=2.2, opacity=0.45)
    canvas.line([(LEFT, y(DEADLINE_MS)), (RIGHT, y(DEADLINE_MS))], stroke=BASE, dash="6 3")
    canvas.text(LEFT - 6, y(DEADLINE_MS) + 4, "33", fill=BASE, anchor="end", bold=True)
    _head(canvas, LATE_TOP, "latency of each forecast, ms (33 ms: one frame)")


def _draw_swap(canvas: Canvas, timeline: Timeline, x: _Scale) -> None:
    """Mark the swap through all panels and say how it came about."""
    swap, at = timeline.swap, x(timeline.swap.told)
    for top, bottom in PANELS:
        canvas.line([(at, top), (at, bottom)], stroke=INK, width=1.2)
    canvas.text(at - 6, ERROR_BOTTOM - 6, "base answers", size=11.5, fill=BASE, anchor="end")
    canvas.text(at + 6, ERROR_BOTTOM - 6, "version 1", size=11.5, fill=SERVED)
    told, first = (1e3 * (later - swap.promoted) for later in (swap.told, swap.first))
    words = (
        f"promoted at {swap.promoted:.1f} s; the version message {told:.0f} ms later, "
        f"the first personal forecast {first:.0f} ms later"
    )
    canvas.text(min(at + 4, RIGHT), BAND_TOP - 11, words, size=11.5, anchor="end")


def _head(canvas: Canvas, top: float, words: str) -> None:
    canvas.text(LEFT, top - 9, words, bold=True)


def _draw_levels(canvas: Canvas, y: _Scale, levels: Sequence[float]) -> None:
    for level in levels:
        canvas.line([(LEFT, y(level)), (RIGHT, y(level))], stroke=GRID)
        canvas.text(LEFT - 6, y(level) + 4, f"{level:g}", fill=QUIET, anchor="end")


def _split(times: np.ndarray, values: np.ndarray) -> list[list[Point]]:
    """Split a curve where it has holes."""
    parts: list[list[Point]] = [[]]
    for t, value in zip(times.tolist(), values.tolist(), strict=True):
        if math.isfinite(value):
            parts[-1].append((t, value))
        elif parts[-1]:
            parts.append([])
    return [part for part in parts if len(part) > 1]
