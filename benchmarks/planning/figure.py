"""The trade-off as a figure: how near the robot comes, by how far it gets, for every margin."""

from benchmarks.live.svg import INK, QUIET, Canvas
from benchmarks.planning.measures import Estimate
from benchmarks.planning.people import METHODS
from benchmarks.planning.report import Report

WIDTH, HEIGHT = 760.0, 420.0
LEFT, RIGHT, TOP, BOTTOM = 64.0, 590.0, 56.0, 366.0
COLOURS = {
    "zero velocity": "#8a6d00",
    "base": "#0b63b0",
    "personal": "#b3400e",
    "truth": "#5a6673",
}
DASHES = {"zero velocity": "2 4", "truth": "7 4"}
GRID = "#e3e8ed"


def draw(report: Report) -> str:
    """Draw a curve per method, a point per margin, bars for the intervals."""
    canvas = Canvas(WIDTH, HEIGHT, title="How near the robot comes, and how far it gets")
    found = {m: [report.estimate(margin, m) for margin in report.margins] for m in METHODS}
    every = [one for estimates in found.values() for one in estimates]
    x = _scale([one["progress_m_per_s"] for one in every], LEFT, RIGHT)
    y = _scale([one["too_close_s_per_min"] for one in every], BOTTOM, TOP)
    _draw_axes(canvas, report, x, y)
    for method, estimates in found.items():
        _draw_method(canvas, method, estimates, x, y)
    _draw_key(canvas)
    return str(canvas)


class Scale:
    """Values to pixels, with round ticks."""

    def __init__(self, low: float, high: float, start: float, end: float) -> None:
        self.low, self.high, self.start, self.end = low, high, start, end

    def __call__(self, value: float) -> float:
        """Give the pixel of a value."""
        share = (value - self.low) / (self.high - self.low)
        return self.start + share * (self.end - self.start)

    def ticks(self) -> list[float]:
        """Give about six round values."""
        size = next(s for s in (0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10) if self.high - self.low < 8 * s)
        first = -(-self.low // size) * size
        count = int((self.high - first) / size) + 1
        return [round(first + k * size, 6) for k in range(count)]


def _scale(values: list[Estimate], start: float, end: float) -> Scale:
    low, high = min(one.low for one in values), max(one.high for one in values)
    pad = 0.06 * (high - low) or 0.1
    return Scale(max(0.0, low - pad) if low < pad else low - pad, high + pad, start, end)


def _draw_axes(canvas: Canvas, report: Report, x: Scale, y: Scale) -> None:
    for value in x.ticks():
        canvas.line([(x(value), TOP), (x(value), BOTTOM)], stroke=GRID)
        canvas.text(x(value), BOTTOM + 17, f"{value:g}", fill=QUIET, anchor="middle")
    for value in y.ticks():
        canvas.line([(LEFT, y(value)), (RIGHT, y(value))], stroke=GRID)
        canvas.text(LEFT - 8, y(value) + 4, f"{value:g}", fill=QUIET, anchor="end")
    canvas.text(LEFT, TOP - 30, "seconds a minute closer than 10 cm", bold=True)
    margins = ", ".join(f"{100 * margin:g}" for margin in report.margins)
    words = f"points from right to left: margins of {margins} cm; bars: 95 %"
    canvas.text(LEFT, TOP - 13, words, size=11.5, fill=QUIET)
    canvas.text(RIGHT, BOTTOM + 38, "progress to the goals, m/s", anchor="end", bold=True)


def _draw_method(
    canvas: Canvas, method: str, estimates: list[dict[str, Estimate]], x: Scale, y: Scale
) -> None:
    colour = COLOURS[method]
    points = []
    for found in estimates:
        far, close = found["progress_m_per_s"], found["too_close_s_per_min"]
        at = x(far.value)
        canvas.line([(at, y(close.low)), (at, y(close.high))], stroke=colour, width=1.0)
        points.append((at, y(close.value)))
    canvas.line(points, stroke=colour, width=2.2, dash=DASHES.get(method))
    canvas.dots(points, fill=colour, size=8, opacity=1.0)


def _draw_key(canvas: Canvas) -> None:
    for place, (method, colour) in enumerate(COLOURS.items()):
        height = TOP + 16 + 22 * place
        canvas.line(
            [(RIGHT + 20, height - 4), (RIGHT + 46, height - 4)],
            stroke=colour,
            width=2.2,
            dash=DASHES.get(method),
        )
        canvas.text(RIGHT + 54, height, method, fill=INK)
