"""Decoders stacked in a device's memory give what each gives alone, whoever is in the batch."""

import gc
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from app.domain.errors import StartError
from app.live.decoders import Computed, Decoders, UnusableWeightsError, read_bones
from app.main import load_decoders
from models.checkpoint import dump_personal
from models.personal import PersonalDecoder
from models.predictor import NetConfig
from models.runtime import stacked
from models.runtime.mixed import forecast_mixed
from models.runtime.stacked import FIRST_ROWS, Stack, StackedDecoder, find_device, find_stack
from tests.unit.models.runtime.test_fused import NET, PEOPLE, WINDOWS, make_net, vary

BASE_SHA256 = "a" * 64
ROOM = WINDOWS.astype(np.float64) + np.array([1.0, 0.0, 30.0])
ROWS = [None, 1, 2, 3, 4, None, 5, 1, 0]
DEVICES = [
    "cpu",
    pytest.param(
        "cuda",
        marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU here"),
    ),
]


def forecast_alone(windows: np.ndarray, people: list[PersonalDecoder | None]) -> np.ndarray:
    given = torch.from_numpy(windows)
    with torch.inference_mode():
        return (forecast_mixed(NET, given, people).frames - given[:, -1:]).numpy()


@pytest.mark.parametrize("device", DEVICES)
def test_each_window_is_answered_by_its_own_decoder_and_gate(device: str) -> None:
    stack = Stack(NET, device)
    added = [stack.add(one) for one in PEOPLE]
    people = [None if row is None else PEOPLE[row] for row in ROWS]
    expected = forecast_alone(WINDOWS, people)
    shares = []
    for count in (9, 1, 4, 9):  # padded, alone, full, and again
        decoders = [None if row is None else added[row] for row in ROWS[:count]]
        displacement, share = stack.forecast(ROOM[:count], decoders)
        assert np.abs(displacement - expected[:count]).max() < 1e-5
        shares = share.tolist()
    with torch.inference_mode():
        own = forecast_mixed(NET, torch.from_numpy(WINDOWS), people).share.numpy()
    assert np.abs(np.array(shares) - own).max() < 1e-4
    assert ((own > 0.05) & (own < 0.95)).any(), "some windows should be blended"


def test_a_batch_may_be_larger_than_the_largest_that_is_computed_at_once() -> None:
    stack = Stack(NET, "cpu")
    own = stack.add(PEOPLE[1])
    windows = np.concatenate([ROOM] * 8)
    decoders = [own if i % 2 else None for i in range(len(windows))]
    displacement, _ = stack.forecast(windows, decoders)
    few, _ = stack.forecast(windows[63:66], decoders[63:66])
    assert len(displacement) == 72
    assert np.abs(displacement[63:66] - few).max() < 1e-6


def test_places_grow_with_the_people_and_are_used_again() -> None:
    stack = Stack(NET, "cpu")
    many = [stack.add(PEOPLE[i % 6]) for i in range(FIRST_ROWS + 5)]
    assert len({one.row for one in many}) == len(many)
    assert 0 not in {one.row for one in many}, "that place is the base's"
    before, _ = stack.forecast(ROOM[:3], [many[1], many[2], many[FIRST_ROWS]])
    freed = many.pop(7).row
    gc.collect()
    taken = stack.add(PEOPLE[0])
    assert taken.row == freed
    after, _ = stack.forecast(ROOM[:3], [many[1], many[2], many[FIRST_ROWS - 1]])
    assert np.array_equal(before, after)
    assert np.abs(before[0] - forecast_alone(WINDOWS[:1], [PEOPLE[1]])[0]).max() < 1e-5


def test_a_place_that_comes_back_while_another_is_filled_gives_nobody_the_same_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stack = Stack(NET, "cpu")
    leaving = [stack.add(PEOPLE[3])]
    write = stacked._write

    def write_slowly(*given: Any) -> None:
        leaving.clear()
        gc.collect()
        write(*given)

    monkeypatch.setattr(stacked, "_write", write_slowly)
    first, second, third = (stack.add(PEOPLE[i]) for i in range(3))
    assert len({first.row, second.row, third.row}) == 3
    displacement, _ = stack.forecast(ROOM[:1], [first])
    assert np.abs(displacement[0] - forecast_alone(WINDOWS[:1], [PEOPLE[0]])[0]).max() < 1e-5


def test_broken_weights_harm_nobody_else() -> None:
    broken = vary(NET.decoder, seed=7)
    broken.cell.weight_hh.fill_(torch.nan)
    strange = replace(PEOPLE[1].familiarity, points=PEOPLE[1].familiarity.points + 1e3)
    stack = Stack(NET, "cpu")
    people = [
        PersonalDecoder(NET, broken, None, {}),
        PEOPLE[1],
        PersonalDecoder(NET, broken, strange, {}),
    ]
    displacement, share = stack.forecast(ROOM[:3], [stack.add(one) for one in people])
    assert np.isnan(displacement[0]).all()
    assert share[2] == 0
    expected = forecast_alone(WINDOWS[:3], [None, PEOPLE[1], None])
    assert np.abs(displacement[1:] - expected[1:]).max() < 1e-5


def test_a_service_builds_and_serves_stacked_decoders() -> None:
    decoders = Decoders(NET, base_sha256=BASE_SHA256, device="cpu")

    def build(person: PersonalDecoder) -> StackedDecoder:
        blob = dump_personal(
            person.decoder,
            {"bones": [0.3] * 8},
            base_sha256=BASE_SHA256,
            familiarity=person.familiarity,
            correction=person.correction,
        )
        built = decoders.build(blob)
        assert isinstance(built, StackedDecoder)
        return built

    built = [build(person) for person in PEOPLE]
    assert read_bones(built[0]) == (0.3,) * 8
    outcomes = decoders.forecast_each(ROOM, [None if row is None else built[row] for row in ROWS])
    expected = forecast_alone(WINDOWS, [None if row is None else PEOPLE[row] for row in ROWS])
    for outcome, alone in zip(outcomes, expected, strict=True):
        assert isinstance(outcome, Computed)
        assert np.abs(outcome.displacement - alone).max() < 1e-5
    assert np.abs(decoders.forecast(ROOM) - forecast_alone(WINDOWS, [None] * 9)).max() < 1e-5
    window = torch.from_numpy(WINDOWS[:1])
    moved = (built[1](window) - window[:, -1:])[0].numpy()
    assert np.abs(moved - forecast_alone(WINDOWS[:1], [PEOPLE[1]])[0]).max() < 1e-5


def test_decoders_of_other_sizes_are_refused_and_take_no_place() -> None:
    stack = Stack(NET, "cpu")
    other = make_net(NetConfig(continuous=33, categories=5, spl_hidden=8, encoder_hidden=64))
    with pytest.raises(RuntimeError):
        stack.add(PersonalDecoder(NET, other.decoder, None, {}))
    assert stack.add(PEOPLE[0]).row == Stack(NET, "cpu").add(PEOPLE[0]).row
    decoders = Decoders(NET, base_sha256=BASE_SHA256, device="cpu")
    with pytest.raises(UnusableWeightsError):
        decoders.build(b"nothing of the kind")


def test_only_nets_of_ours_are_stacked_and_each_once() -> None:
    assert find_stack(NET, None) is None
    assert find_stack(object(), "cpu") is None
    assert find_stack(NET, "cpu") is find_stack(NET, "cpu")


def test_a_device_that_is_not_there_is_one_clear_line() -> None:
    assert find_device("cpu") is None
    assert find_device("auto") == ("cuda" if torch.cuda.is_available() else None)
    with pytest.raises(StartError, match="KINECAST_DEVICE: torch cannot compute on 'abacus'"):
        load_decoders(None, "abacus")
