"""Run studies, show what is known, or say what is missing.

    python -m benchmarks.studies main --jobs 2
    python -m benchmarks.studies all --list
    python -m benchmarks.studies everybody --report
    python -m benchmarks.studies all --page docs/evidence.md

A study trains the bases that it lacks and computes the rows that it lacks, each row kept as soon as
it is known; a run that was ended goes on where it was. `--report` and `--markdown` sum up the rows
that are kept, without recordings; `--page` writes those of all studies into a page.
"""

import argparse
import sys
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from benchmarks.studies.page import fill
from benchmarks.studies.recordings import Place
from benchmarks.studies.runner import (
    ANSWERS,
    STUDIES,
    Run,
    describe_missing,
    list_missing,
    read_rows,
    run_study,
    sum_up,
)
from benchmarks.studies.study import Options, Study
from benchmarks.studies.tables import Table


def main() -> None:
    """Read the command line and do what it says."""
    arguments = _parse()
    chosen = ANSWERS if arguments.study == "all" else [arguments.study]
    run = Run(
        place=Place(arguments.data, arguments.mix),
        options=Options(people=tuple(arguments.people)),
        only=tuple(arguments.only),
        jobs=arguments.jobs,
        fresh=arguments.fresh,
    )
    console = Console(soft_wrap=True)
    if arguments.page:
        page = arguments.page.read_text()
        arguments.page.write_text(fill(page, lambda name: sum_up(name, run)))
        return
    try:
        whole = [_do(STUDIES[name], run, arguments, console) for name in chosen]
    except KeyboardInterrupt:
        console.print("Ended; the rows that are there are kept.")
        sys.exit(130)
    sys.exit(0 if all(whole) else 1)


def _do(study: Study, run: Run, arguments: argparse.Namespace, console: Console) -> bool:
    """Do what was asked for with a study; tell whether all of it could be done."""
    if arguments.list:
        console.print("\n".join(describe_missing(study, run)), markup=False, highlight=False)
        return True
    is_report = arguments.report or arguments.markdown
    rows = read_rows(study, run) if is_report else run_study(study, run, console)
    if not rows:
        console.print(f"{study.name}: no rows yet; `make study-{study.name}`")
    else:
        console.print(f"{study.name}: {study.question}", style="bold", highlight=False)
    for table in study.summarise(rows) if rows else ():
        _print(table, console, is_markdown=arguments.markdown)
    return bool(is_report) or not list_missing(study, replace(run, fresh=False))


def _print(table: Table, console: Console, *, is_markdown: bool) -> None:
    if is_markdown:
        console.print(table.as_markdown(), markup=False, highlight=False)
    else:
        table.show(console)


def _parse() -> argparse.Namespace:
    place = Place.default()
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("study", choices=[*STUDIES, "all"])
    parser.add_argument("--data", type=Path, default=place.utd, help="UTD-MHAD, folder or zip")
    parser.add_argument("--mix", type=Path, default=place.more, help="the other collections")
    parser.add_argument("--jobs", type=int, default=2, help="processes at once (2)")
    parser.add_argument("--only", nargs="+", default=[], help="units by name, * for any")
    parser.add_argument("--people", nargs="+", default=[], help="others, such as utd-mhad/3")
    parser.add_argument("--fresh", action="store_true", help="compute rows that are there again")
    parser.add_argument("--list", action="store_true", help="say what is missing, and end")
    parser.add_argument("--report", action="store_true", help="sum up what is there, and end")
    parser.add_argument("--markdown", action="store_true", help="the same as Markdown")
    parser.add_argument("--page", type=Path, help="write the tables of all into this page, and end")
    return parser.parse_args()


if __name__ == "__main__":
    main()
