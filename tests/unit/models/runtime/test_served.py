"""A service holds decoders as the kernel reads them, and answers as torch would."""

import numpy as np
import pytest
import torch

from app.live.decoders import Computed, Decoders, read_bones
from models.checkpoint import dump_personal, load_personal
from models.personal import PersonalDecoder
from models.rounding import round_matrices
from models.runtime import fused
from models.runtime.fused import PROCESSORS
from models.runtime.served import ServedDecoder
from tests.unit.models.runtime.test_fused import NET, PEOPLE, WINDOWS, make_gate, make_net, vary

pytestmark = pytest.mark.skipif(not PROCESSORS, reason="no kernel was built for this processor")
BASE_SHA256 = "a" * 64
ROOM = WINDOWS.astype(np.float64) + np.array([1.0, 0.0, 30.0])


def dump(person: PersonalDecoder, **metadata: object) -> bytes:
    return dump_personal(
        person.decoder,
        dict(metadata),
        base_sha256=BASE_SHA256,
        familiarity=person.familiarity,
        correction=person.correction,
    )


def test_built_decoders_answer_as_torch_does() -> None:
    decoders = Decoders(NET, base_sha256=BASE_SHA256)
    built = [decoders.build(dump(person, bones=[0.3] * 8)) for person in PEOPLE]
    assert all(isinstance(one, ServedDecoder) for one in built)
    assert read_bones(built[0]) == (0.3,) * 8
    rows = [None, 1, 2, 3, 4, None, 5, 1, 0]
    outcomes = decoders.forecast_each(ROOM, [None if row is None else built[row] for row in rows])
    with torch.inference_mode():
        for window, row, outcome in zip(WINDOWS, rows, outcomes, strict=True):
            given = torch.from_numpy(window)[None]
            alone = (NET if row is None else PEOPLE[row])(given) - given[:, -1:]
            assert isinstance(outcome, Computed)
            assert np.abs(outcome.displacement - alone[0].numpy()).max() < 1e-5
            again = given if row is None else built[row](given)
            assert row is None or float((again - given[:, -1:] - alone).abs().max()) < 1e-5


def test_bases_of_this_process_and_others_are_computed_apart() -> None:
    other = make_net(seed=9)
    decoders = Decoders(NET, base_sha256=BASE_SHA256)
    elsewhere = Decoders(other, base_sha256=BASE_SHA256)
    stranger = PersonalDecoder(other, vary(other.decoder, seed=3), None, {})
    mixed = [decoders.build(dump(PEOPLE[0])), elsewhere.build(dump(stranger)), None, PEOPLE[1]]
    outcomes = decoders.forecast_each(ROOM[:4], mixed)
    with torch.inference_mode():
        for i, net in enumerate((PEOPLE[0], stranger, NET, PEOPLE[1])):
            given = torch.from_numpy(WINDOWS[i : i + 1])
            alone = (net(given) - given[:, -1:])[0].numpy()
            assert np.abs(outcomes[i].displacement - alone).max() < 1e-5


def test_without_a_kernel_decoders_stay_in_torch(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fused, "PROCESSORS", {})
    decoders = Decoders(make_net(), base_sha256=BASE_SHA256)
    built = decoders.build(dump(PEOPLE[0]))
    assert isinstance(built, PersonalDecoder)
    assert isinstance(decoders.forecast_each(ROOM[:1], [built])[0], Computed)


def test_what_was_rounded_is_stored_and_held_in_half_the_bytes_without_loss() -> None:
    person = PersonalDecoder(NET, vary(NET.decoder, seed=8), make_gate(0), {})
    whole = dump(person)
    round_matrices(person.decoder)
    blob = dump(person)
    assert len(blob) < 0.62 * len(whole)
    again = load_personal(blob, NET, base_sha256=BASE_SHA256)
    for one, other in zip(person.decoder.parameters(), again.decoder.parameters(), strict=True):
        assert torch.equal(one, other)
        assert other.dtype == torch.float32
    decoders = Decoders(NET, base_sha256=BASE_SHA256)
    sizes = [decoders.build(one).person.decoder.nbytes for one in (blob, whole)]
    assert sizes[0] < 0.55 * sizes[1]
