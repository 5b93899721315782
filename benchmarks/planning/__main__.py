"""A robot beside recorded people: what does it gain from zero velocity, base, personal, truth?

Run it with `make planning` (needs the UTD-MHAD recordings; about 15 minutes). The same planner
with the same constants works beside each test clip of subjects 2, 4 and 6, for every forecast and
margin; the constants come from subjects 1, 3, 5 and 7 (`--tune` chooses them again, 3 minutes).
Personal versions are what the service would answer with after trial 1; they are fitted once and
kept in `build/planning`.
"""

import argparse
import json
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from time import monotonic
from typing import Any

import torch

from benchmarks.planning.figure import draw
from benchmarks.planning.measures import Tally
from benchmarks.planning.people import METHODS, Scene, read_subject
from benchmarks.planning.report import Report
from benchmarks.planning.robot import Constants
from benchmarks.planning.rounds import TASKS, play
from benchmarks.planning.tune import MARGINS, choose_constants
from benchmarks.studies.cache import RESULTS
from models.checkpoint import SHIPPED, load_checkpoint
from models.data.clips import Clip, load_clips
from models.data.splits import TEST_SUBJECTS, TRAIN_SUBJECTS
from models.training import ledger

JSON = RESULTS / "planning.json"
FIGURE = Path(__file__).parents[2] / "docs/figures/planning.svg"
READINGS = Path(ledger.__file__).with_name("readings.jsonl")


def main() -> None:
    options = parse()
    torch.set_num_threads(1)
    clips = load_clips(options.data)
    constants, tuned = tune(clips) if options.tune else read_constants(options.json)
    scenes = [
        scene
        for subject in TEST_SUBJECTS
        for scene in read_subject(clips, subject, personal=True, say=say)
    ]
    base = load_checkpoint(SHIPPED).sha256
    report = Report(constants, play_all(scenes, constants), count(scenes), base, tuned)
    tables = report.make_tables()
    print("\n".join(table.as_markdown() for table in tables))
    options.json.write_text(json.dumps(report.as_json(), indent=1) + "\n")
    options.figure.write_text(draw(report))
    ledger.record_reading(
        READINGS,
        what="python -m benchmarks.planning",
        config={"people": report.people, "constants": report.as_json()["constants"]},
        figures=report.as_json()["margins"][f"{constants.margin:g}"],
    )


def parse() -> argparse.Namespace:
    default = Path(os.environ.get("UTD_MHAD", "../shared/data/utd-mhad"))
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=default, help="UTD-MHAD, folder or zip")
    parser.add_argument("--tune", action="store_true", help="choose the planner's constants again")
    parser.add_argument("--json", type=Path, default=JSON, help="the figures")
    parser.add_argument("--figure", type=Path, default=FIGURE, help="the curves")
    return parser.parse_args()


def tune(clips: Sequence[Clip]) -> tuple[Constants, list[dict[str, Any]]]:
    """Choose the constants on people who are not reported on, by every third of their clips."""
    scenes = [
        scene
        for subject in TRAIN_SUBJECTS
        for scene in read_subject(clips, subject, personal=False, say=say)
    ]
    return choose_constants(scenes[::3], say=say)


def read_constants(path: Path) -> tuple[Constants, list[dict[str, Any]]]:
    """Give those that were chosen before."""
    kept = json.loads(path.read_text())
    return restore(kept["constants"]), kept["tuned"]


def restore(kept: dict[str, Any]) -> Constants:
    """Give constants as JSON kept them."""
    values: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in kept.items()}
    return Constants(**values)


def play_all(scenes: Sequence[Scene], constants: Constants) -> dict[tuple[float, str], Tally]:
    """Play every round: all margins, forecasts, clips and tasks."""
    tallies = {}
    for margin in MARGINS:
        for method in METHODS:
            began, kept = monotonic(), replace(constants, margin=margin)
            rounds = [[play(s, method, task, kept) for task in range(len(TASKS))] for s in scenes]
            tallies[margin, method] = Tally.count(rounds)
            say(f"margin {margin:g} m, {method}: {monotonic() - began:.0f} s")
    return tallies


def count(scenes: Sequence[Scene]) -> dict[str, int]:
    """Count each subject's clips."""
    subjects = [scene.clip.subject for scene in scenes]
    return {subject: subjects.count(subject) for subject in dict.fromkeys(subjects)}


def say(words: str) -> None:
    print(words, flush=True)


if __name__ == "__main__":
    main()
