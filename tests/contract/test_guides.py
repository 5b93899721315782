"""The guides say the same as each other and as the code."""

import runpy
from pathlib import Path

import pytest

from app.domain.motion import FLAGS
from models.data.clips import load_clips
from tests.contract.pages import quoted, read_blocks, read_page, read_section

TEN_LINES = "with Client("


def read_program(name: str) -> str:
    """The ten lines, as a page has them."""
    found = [block for block in read_blocks(read_page(name), "python") if TEN_LINES in block]
    return found[0]


@pytest.mark.parametrize("name", ["README.md", "clients/python/README.md"])
def test_every_page_has_the_same_ten_lines_as_the_quickstart(name: str) -> None:
    assert read_program(name) == read_program("docs/quickstart.md")


def test_robot_guide_says_what_a_planner_does_with_every_flag() -> None:
    section = read_section("docs/robot-guide.md", "## What a planner does with an answer")
    assert {flag.name for flag in FLAGS} - quoted(section) == set()


def test_recordings_of_another_sensor_become_a_file_that_the_commands_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (block,) = read_blocks(
        read_section("docs/research-guide.md", "## Your own recordings"), "python"
    )
    monkeypatch.chdir(tmp_path)
    (tmp_path / "convert.py").write_text(block)
    runpy.run_path("convert.py")
    clips = load_clips(tmp_path / "mine.npz", subjects={"p1"}, trials={"1"})
    assert [(clip.action, clip.poses.shape) for clip in clips] == [
        ("reach", (90, 20, 3)),
        ("wave", (90, 20, 3)),
    ]
