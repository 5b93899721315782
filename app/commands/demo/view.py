"""The demonstration on a terminal: one row per person, readable without colours too."""

import math
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

from rich.console import Group, RenderableType
from rich.table import Column, Table
from rich.text import Text

from app.commands.demo.person import Report
from app.commands.demo.scores import AHEAD, HISTORY_S, RECENT

_BARS = "▁▂▃▄▅▆▇█"
_MARKS = {"info": ("●", "green"), "degraded": ("▲", "yellow"), "unsafe": ("■", "red")}
_ROOMY = 6
"""Up to so many people, history has a second line."""
_WIDE = 112
"""Columns of a terminal from which everything fits."""
_MIDDLE_S = 0.2
_DEADLINE_MS = 33.0


def draw(
    reports: Sequence[Report], *, url: str, elapsed_s: float, width: int = _WIDE
) -> RenderableType:
    """Draw the state of all streams, on a narrow terminal less of it."""
    clock = f"{int(elapsed_s) // 60}:{int(elapsed_s) % 60:02d}"
    people = "1 person" if len(reports) == 1 else f"{len(reports)} people"
    title = Text.assemble(("Kinecast demo", "bold"), f"  {people} at 30 Hz to {url}  {clock}")
    columns = [column for column in _COLUMNS if width >= _WIDE or not column.wide]
    table = Table(
        *(Column(column.name, justify=column.justify, no_wrap=True) for column in columns),
        box=None,
        pad_edge=False,
        header_style="dim",
    )
    roomy = len(reports) <= _ROOMY
    for report in reports:
        table.add_row(*(column.show(report, roomy) for column in columns))
    legend = Text(
        "error in cm, mean over joints: forecast / standing still · Ctrl+C ends", style="dim"
    )
    return Group(title, Text(), table, Text(), legend)


def describe_plainly(report: Report) -> str:
    """Tell the state of one stream in one line, for output that is no terminal."""
    errors = "  ".join(
        "{:g} s ahead {:.1f} cm, standing still {:.1f} cm".format(
            ahead, *report.scores.errors[ahead].mean(last=RECENT)
        )
        for ahead in AHEAD
    )
    p50, p99 = report.scores.latency()
    return (
        f"{report.user}  {report.action}  {errors}  p50 {p50:.1f} p99 {p99:.1f} ms  "
        f"skipped {report.skipped}  {_name_weights(report)}  {_say_state(report)}"
    )


def to_figures(report: Report) -> dict[str, Any]:
    """Give the figures of one stream as JSON has them; null where there are none."""
    p50, p99 = report.scores.latency()
    errors = {}
    for ahead in AHEAD:
        forecast, standing = report.scores.errors[ahead].mean()
        errors[f"{ahead:g}"] = {
            "forecast_cm": _number(forecast),
            "zero_velocity_cm": _number(standing),
        }
    version = report.version
    return {
        "user": report.user,
        "sent": report.sent,
        "answered": report.answered,
        "skipped": report.skipped,
        "errors": report.refused,
        "reconnects": report.reconnects,
        "trials": report.trials.recorded,
        "jobs": report.trials.jobs,
        "error_cm": errors,
        "latency_ms": {"p50": _number(p50), "p99": _number(p99)},
        "version": None
        if version is None
        else {"number": version.number, "kind": version.kind, "sha256": version.sha256},
    }


def draw_sparkline(values: Sequence[float], *, top: float, width: int) -> str:
    """Draw values from 0 to `top` as bars, the newest at the right."""
    shown = values[-width:]
    if not shown or top <= 0:
        return ""
    highest = len(_BARS) - 1
    return "".join(_BARS[max(0, min(highest, round(value / top * highest)))] for value in shown)


class _Column(NamedTuple):
    """A column: its name, what it shows of a report, and whether it needs a wide terminal."""

    name: str
    show: Callable[[Report, bool], Text]
    justify: Literal["left", "right"] = "left"
    wide: bool = False


def _show_error(ahead: float) -> Callable[[Report, bool], Text]:
    return lambda report, _: _compare(*report.scores.errors[ahead].mean(last=RECENT))


def _show_tail(report: Report, _: object) -> Text:
    p99 = report.scores.latency()[1]
    return Text(_show(p99), style="yellow" if p99 > _DEADLINE_MS else "")


def _compare(forecast: float, standing: float) -> Text:
    """Show an error beside that of standing still, greener the better."""
    if math.isnan(forecast):
        return Text("-", style="dim")
    style = "green" if forecast < standing else "red"
    return Text.assemble((f"{forecast:.1f}", style), (f" / {standing:.1f}", "dim"))


def _draw_history(report: Report, roomy: bool) -> Text:  # noqa: FBT001 - as all columns
    forecast, standing = report.scores.list_history()
    top = max([*forecast, *standing], default=0.0)
    ours = Text(draw_sparkline(forecast, top=top, width=HISTORY_S), style="cyan")
    if not roomy:
        return ours
    theirs = Text(draw_sparkline(standing, top=top, width=HISTORY_S), style="bright_black")
    return Text("\n").join([ours, theirs])


def _mark_state(report: Report) -> Text:
    mark, style = _MARKS.get(report.severity, ("?", "yellow"))
    if report.state != "streaming":
        mark, style = "○", "yellow"
    return Text(f"{mark} {_say_state(report)}", style=style)


def _say_state(report: Report) -> str:
    if report.state != "streaming":
        return report.state
    severe = [flag for flag in report.quality if flag != "uncalibrated"]
    doing = [report.trials.told] if report.trials.told else []
    return " ".join([report.severity or "streaming", *doing, *severe])


def _name_weights(report: Report) -> str:
    version = report.version
    if version is None:
        return "-"
    name = version.kind if not version.number else f"{version.kind} {version.number}"
    return name if version.sha256 is None else f"{name} {version.sha256[:8]}"


def _show(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.1f}"


def _number(value: float) -> float | None:
    return None if math.isnan(value) else round(value, 3)


_COLUMNS = (
    _Column("person", lambda report, _: Text(report.user, style="bold")),
    _Column("doing", lambda report, _: Text(report.action)),
    *(
        _Column(f"{ahead:g} s", _show_error(ahead), "right", wide=ahead == _MIDDLE_S)
        for ahead in AHEAD
    ),
    _Column("0.5 s, history", _draw_history, wide=True),
    _Column("p50", lambda report, _: Text(_show(report.scores.latency()[0])), "right"),
    _Column("p99 ms", _show_tail, "right"),
    _Column("skipped", lambda report, _: Text(str(report.skipped)), "right"),
    _Column("weights", lambda report, _: Text(_name_weights(report)), wide=True),
    _Column("state", lambda report, _: _mark_state(report)),
)
