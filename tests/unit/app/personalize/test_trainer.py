import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from app.domain.versions import Verdict
from app.personalize.run import Lesson
from app.personalize.trainer import train
from models.checkpoint import dump_checkpoint, dump_personal, load_checkpoint, load_personal
from models.data.clips import Clip
from models.data.synthetic import SyntheticPerson
from models.data.synthetic_actions import ACTIONS
from models.predictor import Predictor
from models.training.finetune import FinetuneConfig
from models.uncertainty import LEVELS, RadiusTable
from tests.nets import SMALL

QUICK = FinetuneConfig(steps=12, batch=16, copies=1)


@pytest.fixture(scope="module")
def base() -> bytes:
    torch.manual_seed(0)
    predictor = Predictor(config=SMALL)
    with torch.no_grad():
        for weight in predictor.decoder.parameters():
            weight.add_(0.01 * torch.randn_like(weight))
    table = np.linspace(0.05, 0.4, len(LEVELS), dtype=np.float32)[:, None, None]
    radius = RadiusTable(np.broadcast_to(table, (len(LEVELS), 15, 20)).copy(), LEVELS, "nobody")
    return dump_checkpoint(predictor, {}, radius=radius)


def record(trial: str, *, seed: int = 1, clips: int = 6) -> list[Clip]:
    actions = list(ACTIONS)
    return [
        Clip(
            SyntheticPerson(seed).record(actions[i % len(actions)], 2.5),
            "",
            f"{i}",
            trial,
            "kinecast",
        )
        for i in range(clips)
    ]


def test_a_first_trial_becomes_weights_with_gate_radius_bones_and_figures(base: bytes) -> None:
    told: list[dict] = []
    lesson = Lesson(base, None, tuple(record("one")))
    learned = train(lesson, lambda values: told.append(dict(values)), config=QUICK)
    assert learned.verdict in {Verdict.PROMOTE, Verdict.REJECT}
    checkpoint = load_checkpoint(base)
    assert learned.blob is not None
    personal = load_personal(learned.blob, checkpoint.predictor, base_sha256=checkpoint.sha256)
    assert personal.familiarity is not None
    assert len(personal.metadata["bones"]) == 8
    assert 0.5 <= personal.metadata["radius_scale"] <= 2
    assert personal.metadata["blend"] == learned.metrics["blend"]
    assert personal.familiarity.rule.half == learned.metrics["reach"]
    assert learned.metrics["seen"]["clips"] > 0
    assert learned.metrics["unseen"]["clips"] >= 2
    assert [line["step"] for line in told] == list(range(1, 3 * QUICK.steps + 1))
    assert told[-1]["steps"] == 3 * QUICK.steps
    assert told[-1]["seconds_left"] == 0
    assert {line["phase"] for line in told} == {"judging", "fitting"}


def test_the_same_lesson_gives_the_same_bytes(base: bytes) -> None:
    lesson = Lesson(base, None, tuple(record("one")))
    first = train(lesson, lambda _: None, config=QUICK)
    second = train(lesson, lambda _: None, config=QUICK)
    assert first.blob == second.blob
    assert first.metrics == second.metrics


def test_an_operator_may_ask_for_fewer_steps(base: bytes) -> None:
    told: list[dict] = []
    lesson = Lesson(base, None, tuple(record("one")), steps=2)
    learned = train(lesson, lambda values: told.append(dict(values)))
    assert told[-1]["steps"] == 3 * 2
    assert learned.blob is not None
    checkpoint = load_checkpoint(base)
    personal = load_personal(learned.blob, checkpoint.predictor, base_sha256=checkpoint.sha256)
    assert personal.metadata["finetuning"]["steps"] == 2


def test_too_few_clips_are_told_so(base: bytes) -> None:
    learned = train(Lesson(base, None, tuple(record("one", clips=3))), lambda _: None, config=QUICK)
    assert learned.verdict is Verdict.TOO_LITTLE_DATA
    assert learned.blob is None
    assert "told apart: 3;" in learned.message


def test_a_second_trial_meets_the_active_version_where_it_was_not_trained(base: bytes) -> None:
    first = tuple(record("one"))
    active = train(Lesson(base, None, first), lambda _: None, config=QUICK)
    both = (*first, *record("two"))
    known = Lesson(base, active.blob, both, active_trials=frozenset({"one"}))
    learned = train(known, lambda _: None, config=QUICK)
    told = learned.metrics["rival"]
    assert told.pop("where") == "the new trial"
    assert set(told) == {"base_cm2", "active_cm2", "candidate_cm2"}
    nothing_new = replace(known, active_trials=frozenset({"one", "two"}))
    assert "rival" not in train(nothing_new, lambda _: None, config=QUICK).metrics


def test_on_a_new_base_a_fit_must_not_lose_against_fits_on_the_old_one(base: bytes) -> None:
    clips, told = tuple(record("one")), list[dict]()
    active = train(Lesson(base, None, clips), lambda _: None, config=QUICK)
    worse = load_checkpoint(base)
    with torch.no_grad():
        for weight in worse.predictor.decoder.parameters():
            weight.add_(0.1 * torch.randn_like(weight))
    blob = dump_checkpoint(worse.predictor, {}, radius=worse.radius)
    again = Lesson(blob, active.blob, clips, active_base=base, active_trials=frozenset({"one"}))
    learned = train(again, lambda values: told.append(dict(values)), config=QUICK)
    assert learned.metrics["rival"]["where"] == "motion left out"
    assert learned.metrics["rival"]["candidate_cm2"] > learned.metrics["rival"]["active_cm2"]
    assert learned.verdict is Verdict.REJECT
    assert told[-1]["step"] == told[-1]["steps"] == 5 * QUICK.steps
    same = replace(again, base=base)
    figures = train(same, lambda _: None, config=QUICK).metrics["rival"]
    assert figures["candidate_cm2"] == figures["active_cm2"]


def test_an_active_version_without_a_correction_is_refought_without_one(base: bytes) -> None:
    clips = tuple(record("one"))
    active = train(Lesson(base, None, clips), lambda _: None, config=QUICK)
    net, sha256 = load_checkpoint(base).predictor, load_checkpoint(base).sha256
    known = load_personal(active.blob, net, base_sha256=sha256)
    older = dump_personal(known.decoder, {}, base_sha256=sha256, familiarity=known.familiarity)
    again = Lesson(base, older, clips, active_base=base, active_trials=frozenset({"one"}))
    figures = train(again, lambda _: None, config=QUICK).metrics["rival"]
    assert figures["candidate_cm2"] != figures["active_cm2"]


def test_an_active_version_that_nobody_can_read_is_nothing_to_compare_with(base: bytes) -> None:
    lesson = Lesson(base, b"rotten", tuple(record("one")))
    assert "rival" not in train(lesson, lambda _: None, config=QUICK).metrics


def test_a_fit_that_goes_astray_is_rejected_and_leaves_no_weights(base: bytes) -> None:
    config = replace(QUICK, learning_rate=1e30)
    told: list[dict] = []
    lesson = Lesson(base, None, tuple(record("one")))
    learned = train(lesson, lambda line: told.append(dict(line)), config=config)
    assert (learned.verdict, learned.blob) == (Verdict.REJECT, None)
    assert "astray" in learned.message
    assert json.dumps(told, allow_nan=False)
