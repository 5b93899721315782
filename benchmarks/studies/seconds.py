"""What a second of fitting brings: errors by the time that a fit may take, and what it costs."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from time import monotonic
from typing import Any

import torch

from app.personalize.judge import BLEND
from app.personalize.offline import personalize
from app.personalize.trainer import learn_rest
from benchmarks.studies.cache import Row
from benchmarks.studies.everybody import find_base
from benchmarks.studies.measured import Measured, measure
from benchmarks.studies.recordings import UTD, read_person
from benchmarks.studies.study import Lab, Options, Study, Unit
from benchmarks.studies.tables import FRAME_COLUMNS, Table, cells
from models.arithmetic import arithmetic
from models.baselines import Forecaster
from models.baselines.closed_form import KernelCorrection
from models.checkpoint import load_checkpoint
from models.data.clips import Clip
from models.data.splits import PERSONAL_TRIAL, TEST_SUBJECTS, TEST_TRIALS
from models.personal import PersonalDecoder
from models.predictor import Predictor
from models.training.finetune import FinetuneConfig, blend, encode_clips, fit_decoder

BUDGETS_S = (1.0, 2.0, 5.0, 10.0, 20.0, 60.0)
ENCODING_SHARE = 0.3
"""Part of a budget that copies of windows may take to be encoded."""
TIMED = f"{UTD}/2"
Correct = Callable[[Predictor, Sequence[Clip]], Forecaster]
CORRECTIONS: dict[str, Correct] = {"closed form": KernelCorrection.fit}
"""Personal versions in closed form, by name; each becomes a line beside the fits."""
METHODS = {"plain": "fitted", "gated": f"{BLEND:.0%} and gated"}


def plan(options: Options) -> list[Unit]:
    """List fits by budget, corrections, and whole runs by threads; others with `--people`."""
    people = options.people or tuple(f"{UTD}/{subject}" for subject in TEST_SUBJECTS)
    units = [
        Unit(
            f"{person}, {budget:g} s", find_base(person), person, {"budget_s": budget}, budget + 15
        )
        for person in people
        for budget in BUDGETS_S
    ]
    units += [
        Unit(f"{person}, {name}", find_base(person), person, {"correction": name}, 10.0)
        for person in people
        for name in CORRECTIONS
    ]
    return units + [
        Unit(
            f"{TIMED}, {'with' if judged else 'without'} judge, {threads} threads",
            find_base(TIMED),
            TIMED,
            {"threads": threads, "judged": judged},
            60.0,
        )
        for judged in (False, True)
        for threads in (1, 2)
    ]


def compute(unit: Unit, lab: Lab) -> dict[str, Any]:
    """Fit within a budget, correct in closed form, or time a whole run."""
    trial = read_person(lab.place, unit.person, PERSONAL_TRIAL)
    base = lab.read_base(unit.base)
    if "threads" in unit.settings:
        return time_run(base, trial, unit.settings["threads"], judged=unit.settings["judged"])
    net = load_checkpoint(base).predictor
    test = read_person(lab.place, unit.person, *TEST_TRIALS)
    with arithmetic(1):
        if "correction" in unit.settings:
            methods, told = correct(net, trial, CORRECTIONS[unit.settings["correction"]])
        else:
            methods, told = fit_within(net, trial, unit.settings["budget_s"])
    return {**told, "errors": measure({"base": net, **methods}, test).as_json()}


def fit_within(
    net: Predictor, trial: Sequence[Clip], budget_s: float
) -> tuple[dict[str, Forecaster], dict[str, Any]]:
    """Fit as many steps as the budget holds, on as many copies as leave most of it to them."""
    probe = probe_speed(net, trial)
    config = spend(budget_s, **probe)
    began = monotonic()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        encodings = encode_clips(net, trial, config)
        encoded = monotonic()
        decoder = fit_decoder(net, encodings, config)
    fitted = monotonic()
    gated = learn_rest(net, blend(net.decoder, decoder, BLEND), trial)
    return {"plain": PersonalDecoder(net, decoder, None, {}), "gated": gated}, {
        "steps": config.steps,
        "copies": config.copies,
        "windows": len(encodings),
        "encoding_s": round(encoded - began, 3),
        "fit_s": round(fitted - encoded, 3),
        "gate_s": round(monotonic() - fitted, 3),
        **{name: round(value, 5) for name, value in probe.items()},
    }


def probe_speed(net: Predictor, trial: Sequence[Clip], *, steps: int = 20) -> dict[str, float]:
    """Time the encoding of a copy of every window, and a step of a fit."""
    config = replace(FinetuneConfig(), copies=1)
    with torch.random.fork_rng(devices=[]):
        encodings = encode_clips(net, trial, config)  # the first time takes longer
        fit_decoder(net, encodings, replace(FinetuneConfig(), steps=1))  # here too
        began = monotonic()
        encodings = encode_clips(net, trial, config)
        encoded = monotonic()
        fit_decoder(net, encodings, replace(FinetuneConfig(), steps=steps))
    return {"copy_s": encoded - began, "step_s": (monotonic() - encoded) / steps}


def spend(budget_s: float, *, copy_s: float, step_s: float) -> FinetuneConfig:
    """Divide a budget into copies and steps."""
    most = FinetuneConfig().copies
    copies = min(most, max(1, int(ENCODING_SHARE * budget_s / copy_s)))
    steps = max(1, int((budget_s - copies * copy_s) / step_s))
    return replace(FinetuneConfig(), steps=steps, copies=copies)


def correct(
    net: Predictor, trial: Sequence[Clip], correction: Correct
) -> tuple[dict[str, Forecaster], dict[str, Any]]:
    """Make a personal version in closed form."""
    began = monotonic()
    return {"plain": correction(net, trial)}, {"fit_s": round(monotonic() - began, 3)}


def time_run(base: bytes, trial: Sequence[Clip], threads: int, *, judged: bool) -> dict[str, Any]:
    """Time a run from clips to a version, with checks, folds and judge or without."""
    began = monotonic()
    if judged:
        personalize(base, trial, lambda _: None, threads=threads)
        return {"run_s": round(monotonic() - began, 2)}
    net, config = load_checkpoint(base).predictor, FinetuneConfig()
    with arithmetic(threads):
        began = monotonic()
        encodings = encode_clips(net, trial, config)
        encoded = monotonic()
        decoder = fit_decoder(net, encodings, config)
        fitted = monotonic()
        learn_rest(net, decoder, trial)
    return {
        "run_s": round(monotonic() - began, 2),
        "encoding_s": round(encoded - began, 2),
        "fit_s": round(fitted - encoded, 2),
        "gate_s": round(monotonic() - fitted, 2),
    }


def tell(row: Row) -> str:
    """Write a row in a line."""
    if "errors" not in row:
        return f"{row['run_s']:.1f} s"
    found = Measured.from_json(row["errors"])
    errors = [f"{method} {found.cm2(method)[-1]:.2f}" for method in found.sums]
    return f"{row.get('steps', 0)} steps in {row['fit_s']:.1f} s, cm²: {', '.join(errors)}"


def summarise(rows: Sequence[Row]) -> list[Table]:
    """Show errors by budget, and what a run costs."""
    fits = [row for row in rows if "errors" in row]
    runs = [row for row in rows if "threads" in row]
    return [_show_fits(fits), _show_runs(runs)]


def tell_cost(row: Row, method: str) -> float:
    """Give the seconds that a method of a row took, gate and correction included if it has them."""
    cost: float = row.get("encoding_s", 0.0) + row["fit_s"]
    return cost + row["gate_s"] if method == "gated" else cost


def _show_fits(rows: Sequence[Row]) -> Table:
    lines, shown = [], set[str]()
    for row in rows:
        found, person = Measured.from_json(row["errors"]), row["person"]
        if person not in shown:
            lines.append((person, "base", "-", "-", "-", *cells(found.cm2("base"))))
            shown.add(person)
        budget = f"{row['budget_s']:g} s" if "budget_s" in row else row["correction"]
        steps = f"{row.get('steps', '-')}"
        lines += [
            (
                person,
                name,
                budget,
                f"{tell_cost(row, method):.1f}",
                steps,
                *cells(found.cm2(method)),
            )
            for method, name in METHODS.items()
            if method in found.sums
        ]
    columns = ("person", "", "budget", "seconds", "steps", *FRAME_COLUMNS)
    title = "cm², mean over frames 1..k, fitted to trial 1 within a budget of one core's time"
    return Table(title, columns, lines)


def _show_runs(rows: Sequence[Row]) -> Table:
    lines = [
        (
            "checks, folds, judge, fit" if row["judged"] else "fit and gate alone",
            str(row["threads"]),
            f"{row['run_s']:.1f}",
            *(f"{row[part]:.1f}" if part in row else "-" for part in ("encoding_s", "fit_s")),
        )
        for row in rows
    ]
    columns = ("from clips to a version", "threads", "seconds", "encoding", "fit")
    return Table(f"Whole runs on trial 1 of {TIMED}, alone on the machine", columns, lines)


STUDY = Study("seconds", "What is a second worth?", 1, plan, compute, tell, summarise, alone=True)
