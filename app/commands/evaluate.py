"""`kinecast evaluate`: the table of errors, of a base and of what it becomes for a person."""

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from app.commands.files import read_clips, refuse_place
from app.commands.output import fail
from app.commands.scoring import order, score_base, score_baselines, score_personal
from app.commands.tables import show_comparison, show_coverage, show_measures
from models.checkpoint import SHIPPED, Checkpoint, CheckpointError, load_checkpoint
from models.data.clips import Clip
from models.data.splits import TEST_TRIALS, select
from models.training import evaluate as evaluation
from models.training.compare import gather_cells, summarise
from models.training.ledger import record_reading
from models.training.simlpe_file import SimlpeFile, load_simlpe


def evaluate_command(
    data: Annotated[
        Path, typer.Option(help="Folder or zip of UTD-MHAD, or an .npz of the documented keys.")
    ],
    subjects: Annotated[str | None, typer.Option(help="Subjects, such as 2,4,6.")] = None,
    personalize_trials: Annotated[
        str | None,
        typer.Option(help="Trials to fine-tune each subject on, such as 1; needs --subjects."),
    ] = None,
    finetune_steps: Annotated[
        int | None, typer.Option(min=1, help="Steps of a fit; those of the recipe unless told.")
    ] = None,
    test_trials: Annotated[
        str | None, typer.Option(help="Trials to test on; 2,3,4 of UTD-MHAD, all of an .npz.")
    ] = None,
    model: Annotated[Path, typer.Option(help="The checkpoint to score.")] = SHIPPED,
    json_out: Annotated[
        Path | None, typer.Option("--json", help="Write the figures here; - prints them.")
    ] = None,
    simlpe: Annotated[
        Path | None,
        typer.Option(help="A peer to compare with, as `kinecast pretrain-peer` writes it."),
    ] = None,
    log: Annotated[
        Path | None,
        typer.Option(help="Append commit, settings and figures to this ledger, a line per run."),
    ] = None,
    *,
    baselines: Annotated[
        bool,
        typer.Option(
            "--baselines",
            help="Score damped velocity, ridge and --simlpe as well, and print all on one screen "
            "beside the paper's rows, with ratios.",
        ),
    ] = False,
) -> None:
    """Print the error table of a model: cm² and mm, by subject and frame, against baselines.

    Readings of UTD-MHAD's subjects 2, 4 and 6 belong in the ledger:
    --log models/training/readings.jsonl.
    """
    if personalize_trials and not subjects:
        fail("--personalize-trials needs --subjects: every person is fine-tuned alone", status=2)
    if simlpe is not None and not baselines:
        fail("--simlpe needs --baselines", status=2)
    _refuse_places(json_out, log)
    checkpoint, peer = _load(model, simlpe)
    everybody = read_clips(data, None)
    trials = test_trials.split(",") if test_trials else _default_trials(data)
    own = personalize_trials.split(",") if personalize_trials else []
    test = _pick(everybody, data, subjects, trials, own)
    rows = score_base(checkpoint, test, by_subject=bool(subjects))
    if baselines:
        rows += score_baselines(
            everybody, test, own, peer, by_subject=bool(subjects), steps=finetune_steps
        )
    if own:
        rows += score_personal(model, everybody, test, own, steps=finetune_steps)
    rows = order(rows)
    published = _is_paper_protocol(data, trials)
    described = {"file": model.name, "sha256": checkpoint.sha256}
    protocol = evaluation.describe_protocol(test, model=described)
    compared = _compare(rows, simlpe, peer, published=published) if baselines else {}
    if log is not None:
        settings = {"personalize_trials": own, "finetune_steps": finetune_steps}
        _log(log, {"data": data.name, **protocol, **settings, **compared}, rows)
    if json_out is not None:
        report = {"protocol": protocol, "rows": [row.as_json() for row in rows], **compared}
        _write_json(json_out, report)
    if json_out is None or str(json_out) != "-":
        show = show_comparison if baselines else show_measures
        show(rows, published=published)
        show_coverage(rows)


def _refuse_places(json_out: Path | None, log: Path | None) -> None:
    places = {"--json": None if str(json_out) == "-" else json_out, "--log": log}
    for option, path in places.items():
        if path is not None:
            refuse_place(option, path)
            if not path.parent.is_dir():
                fail(f"{option}: there is no folder {path.parent}", status=2)


def _load(model: Path, simlpe: Path | None) -> tuple[Checkpoint, SimlpeFile | None]:
    path = model
    try:
        checkpoint = load_checkpoint(path)
        path = simlpe or model
        return checkpoint, load_simlpe(simlpe) if simlpe else None
    except (OSError, CheckpointError) as error:
        fail(f"{path}: {error}", status=2)


def _pick(
    everybody: Sequence[Clip],
    data: Path,
    subjects: str | None,
    trials: Sequence[str] | None,
    own: Sequence[str],
) -> list[Clip]:
    if set(own) & set(trials or own):
        fail("a trial that is trained on cannot be tested on: set --test-trials", status=2)
    test = select(everybody, subjects=subjects.split(",") if subjects else None, trials=trials)
    if not test:
        wanted = f"subjects {subjects or 'any'} and trials {','.join(trials or ['any'])}"
        fail(f"no clips of {wanted} in {data}", status=2)
    return test


def _compare(
    rows: Sequence[evaluation.Row],
    simlpe: Path | None,
    peer: SimlpeFile | None,
    *,
    published: bool,
) -> dict[str, Any]:
    summaries = summarise(gather_cells(rows, published=published))
    named = {"file": simlpe.name, "sha256": peer.sha256} if simlpe and peer else None
    return {"simlpe": named, "comparison": [found.as_json() for found in summaries]}


def _default_trials(data: Path) -> Sequence[str] | None:
    return None if data.suffix == ".npz" else TEST_TRIALS


def _is_paper_protocol(data: Path, trials: Sequence[str] | None) -> bool:
    return data.suffix != ".npz" and trials is not None and tuple(trials) == TEST_TRIALS


def _log(path: Path, config: Mapping[str, Any], rows: Sequence[evaluation.Row]) -> None:
    figures = [
        {"method": row.method, "subject": row.subject, "mse_cm2": row.scores.mse_cm2}
        for row in rows
    ]
    record_reading(path, what="kinecast evaluate", config=config, figures=figures)


def _write_json(path: Path, report: Mapping[str, object]) -> None:
    text = json.dumps(report, indent=1)
    if str(path) == "-":
        sys.stdout.write(text + "\n")
    else:
        path.write_text(text + "\n")
