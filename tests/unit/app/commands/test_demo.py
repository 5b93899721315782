"""What the demonstration counts, and what it shows."""

import io
import math

import numpy as np
import pytest
from rich.console import Console

from app.commands.client.messages import Version
from app.commands.demo.person import Report
from app.commands.demo.scores import Scores, mean_distance_cm
from app.commands.demo.view import describe_plainly, draw, draw_sparkline, to_figures


def move(frame: int) -> np.ndarray:
    """Somebody who slides along x by 1 cm in each frame."""
    pose = np.zeros((20, 3), np.float32)
    pose[:, 0] = 0.01 * frame
    return pose


def foretell(seq: int, *, off_m: float = 0.0) -> np.ndarray:
    """The true future of `move`, off by a constant in y."""
    future = np.stack([move(seq + k) for k in range(1, 16)])
    future[:, :, 1] += off_m
    return future


def watch(frames: int, *, off_m: float = 0.0, skip: int | None = None) -> Scores:
    scores = Scores()
    for seq in range(frames):
        if seq != skip:
            scores.see(seq, move(seq))
        if seq >= 14:
            scores.foresee(seq, foretell(seq, off_m=off_m), latency_ms=float(seq))
    return scores


def test_distance_is_the_mean_over_joints_in_centimetres() -> None:
    pose = np.zeros((2, 3), np.float32)
    other = np.array([[0.03, 0.04, 0.0], [0.0, 0.0, 0.0]], np.float32)
    assert mean_distance_cm(pose, other) == pytest.approx(2.5)


def test_forecasts_are_compared_with_what_came_and_with_standing_still() -> None:
    scores = watch(60, off_m=0.02)
    for ahead, frames in ((0.1, 3), (0.2, 6), (0.5, 15)):
        forecast, standing = scores.errors[ahead].mean()
        assert forecast == pytest.approx(2.0, abs=1e-3)
        assert standing == pytest.approx(frames, abs=1e-3)
        assert len(scores.errors[ahead].forecast) == 60 - 14 - 15


def test_a_frame_that_never_was_spoils_only_its_own_comparisons() -> None:
    scores = watch(60, skip=40)
    assert scores.errors[0.5].mean()[0] == pytest.approx(0.0, abs=1e-3)
    assert len(scores.errors[0.5].forecast) == 60 - 14 - 15 - 2


def test_nothing_is_judged_across_a_lost_stream() -> None:
    scores = watch(20)
    scores.forget()
    for seq in range(100, 130):
        scores.see(seq, move(seq))
    assert len(scores.errors[0.5].forecast) == 0
    assert math.isnan(scores.errors[0.5].mean()[0])


def test_history_has_one_value_a_second_and_latency_its_tail() -> None:
    forecast, standing = watch(14 + 15 + 90, off_m=0.02).list_history()
    assert forecast == pytest.approx([2.0] * 3, abs=1e-3)
    assert standing == pytest.approx([15.0] * 3, abs=1e-3)
    p50, p99 = watch(114).latency()
    assert (p50, round(p99)) == (63.5, 112)


def test_sparkline_is_scaled_and_cut_to_the_newest() -> None:
    assert draw_sparkline([0.0, 5.0, 10.0], top=10.0, width=8) == "▁▅█"
    assert draw_sparkline([9.0, 0.0, 10.0], top=10.0, width=2) == "▁█"
    assert draw_sparkline([], top=0.0, width=5) == ""


def make_report(**fields: object) -> Report:
    version = Version(0, "base", "0123456789abcdef")
    given = {"action": "walk", "state": "streaming", "version": version, "severity": "info"}
    given |= fields
    return Report(given.pop("user", "demo-1"), scores=watch(120, off_m=0.02), **given)


def show(*reports: Report, width: int = 120) -> str:
    paper = io.StringIO()
    picture = draw(reports, url="http://here", elapsed_s=75.0, width=width)
    Console(width=width, file=paper).print(picture)
    return paper.getvalue()


def test_table_can_be_read_without_colours() -> None:
    text = show(make_report(skipped=3), make_report(severity="unsafe", quality=("mirrored",)))
    assert "2 people" in text
    assert "1:15" in text
    assert "2.0 / 15.0" in text
    assert "base 01234567" in text
    assert "● info" in text
    assert "■ unsafe mirrored" in text
    assert "█" in text


@pytest.mark.parametrize("width", [80, 120])
def test_table_fits_the_terminal(width) -> None:
    report = make_report(action="sit_and_work", user="demo-12", severity="unsafe")
    text = show(report, make_report(), width=width)
    assert "…" not in text
    assert "■ unsafe" in text
    assert ("history" in text) is (width == 120)


def test_people_without_a_forecast_are_shown_too() -> None:
    text = show(Report("demo-7", state="lost: connection_lost"))
    assert "demo-7" in text
    assert "○ lost: connection_lost" in text
    assert to_figures(Report("demo-7"))["latency_ms"] == {"p50": None, "p99": None}


def test_plain_line_and_figures_say_the_same() -> None:
    report = make_report(sent=120, answered=106)
    assert "0.5 s ahead 2.0 cm, standing still 15.0 cm" in describe_plainly(report)
    figures = to_figures(report)
    assert figures["error_cm"]["0.5"] == {"forecast_cm": 2.0, "zero_velocity_cm": 15.0}
    assert figures["version"]["sha256"] == "0123456789abcdef"
