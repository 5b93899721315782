"""The kernel gives what torch gives, whoever is in the batch."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from models.correction import Correction
from models.decoder import Decoder
from models.familiarity import Familiarity, FamiliarityRule
from models.personal import PersonalDecoder
from models.predictor import NetConfig, Predictor
from models.rounding import round_matrices
from models.runtime import fused
from models.runtime.fused import KERNEL, PROCESSORS, PackedPerson, find_packed, forecast_fused
from models.runtime.pack import (
    KINDS,
    Packed,
    find_packed_kind,
    pack_correction,
    pack_decoder,
    pack_gate,
)
from models.symmetry import Symmetry
from tests.nets import SMALL
from tests.unit.models.conftest import believable_motion

pytestmark = pytest.mark.skipif(not PROCESSORS, reason="no kernel was built for this processor")
SIZES = NetConfig(
    encoder_hidden=64,
    encoder_heads=2,
    continuous=33,
    categories=5,
    decoder_token=64,
    decoder_hidden=128,
    decoder_heads=4,
    spl_hidden=16,
)


def make_net(config: NetConfig = SIZES, *, seed: int = 0) -> Predictor:
    torch.manual_seed(seed)
    net = Predictor(config=config).eval().requires_grad_(requires_grad=False)
    for weight in net.parameters():
        weight.add_(0.05 * torch.randn_like(weight))
    net.normalizer.fit(torch.from_numpy(np.stack([believable_motion(i, 15) for i in range(8)])))
    return net


def vary(decoder: Decoder, *, seed: int, kind: str = "float32") -> Decoder:
    torch.manual_seed(seed)
    other = copy.deepcopy(decoder)
    for weight in other.parameters():
        weight.mul_(1 + 0.1 * torch.randn_like(weight))
        weight.copy_(weight.to(getattr(torch, kind)).float())
    return other


NET = make_net()
WINDOWS = np.stack([believable_motion(i, 15) for i in range(9)])
PLACED = WINDOWS + np.array([3.0, 0.0, 40.0], np.float32)


def make_gate(row: int) -> Familiarity:
    """A gate that knows one of the windows well, and the others less."""
    z = NET.encode(torch.from_numpy(WINDOWS)).z
    points = z[row] + 0.3 * torch.randn(30, z.shape[1], generator=torch.manual_seed(row))
    return Familiarity.fit(torch.cat([points, z[row : row + 1]]), FamiliarityRule(width=3.0))


def make_correction(gate: Familiarity, row: int) -> Correction:
    """A correction of some centimetres near what a gate knows."""
    random = torch.manual_seed(row)
    z = NET.encode(torch.from_numpy(WINDOWS)).z
    coordinates = 3 * NET.spec.horizon * NET.spec.joints
    missed = 0.2 * torch.randn(len(z), coordinates, generator=random)
    return replace(Correction.fit(gate, z, missed), width=1.5)


def make_person(row: int) -> PersonalDecoder:
    """A decoder; some have a gate, and some of those a correction."""
    decoder = vary(NET.decoder, seed=row, kind=KINDS[row % 3])
    gate = None if row % 4 == 0 else make_gate(row)
    correction = make_correction(gate, row) if gate is not None and row % 2 else None
    return PersonalDecoder(NET, decoder, gate, {}, correction)


def pack(one: PersonalDecoder) -> PackedPerson:
    return PackedPerson(
        pack_decoder(one.decoder),
        None if one.familiarity is None else pack_gate(one.familiarity),
        None if one.correction is None else pack_correction(one.correction),
    )


SMALL_GATE = Familiarity.fit(torch.randn(7, SIZES.continuous, generator=torch.manual_seed(0)))
PEOPLE = [make_person(row) for row in range(6)]
PACKED = [pack(one) for one in PEOPLE]


def make_rounded(net: Predictor) -> Predictor:
    rounded = copy.deepcopy(net)
    round_matrices(rounded)
    return rounded


def make_symmetric() -> Predictor:
    net = make_net(replace(SIZES, continuous=34))
    Symmetry(net).impose(net)
    return net


NETS = {
    "float32": NET,
    "bfloat16": make_rounded(NET),
    "symmetric float32": make_symmetric(),
    "symmetric bfloat16": make_rounded(make_symmetric()),
}


def check(windows: np.ndarray, rows: list[int | None], processor: str) -> np.ndarray:
    base = find_packed(NET)
    assert base is not None
    people = [None if row is None else PACKED[row] for row in rows]
    made = forecast_fused(base, windows, people, processor=processor)
    for i, row in enumerate(rows):
        window = torch.from_numpy(windows[i : i + 1])
        share = torch.zeros(1)
        if row is None:
            frames = NET(window)
        else:
            frames, share = PEOPLE[row].forecast(NET.encode(window), window)
        apart = made.displacement[i] - (frames[0] - window[0, -1:]).numpy()
        assert np.abs(apart).max() < 1e-5
        assert made.share[i] == pytest.approx(float(share), abs=1e-4)
        steps = np.diff(made.displacement[i], axis=0, prepend=0)
        assert made.fastest[i] == pytest.approx((steps**2).sum(-1).max(), rel=1e-4)
    return made.share


@pytest.mark.parametrize("processor", PROCESSORS)
@given(rows=st.lists(st.none() | st.integers(0, len(PEOPLE) - 1), min_size=1, max_size=9))
@settings(max_examples=25, deadline=None)
def test_every_row_is_what_torch_makes_of_it_alone(processor: str, rows: list[int | None]) -> None:
    check(WINDOWS[: len(rows)], rows, processor)


@pytest.mark.parametrize("processor", PROCESSORS)
def test_shares_between_nothing_and_everything_blend(processor: str) -> None:
    share = check(WINDOWS[:6], [1, 2, 4, 5, 1, 2], processor)
    assert ((share > 0.02) & (share < 0.98)).any()


@pytest.mark.parametrize("processor", PROCESSORS)
def test_the_place_in_the_room_and_the_heading_do_not_matter_more_than_to_torch(
    processor: str,
) -> None:
    turned = PLACED[..., [2, 1, 0]] * np.array([1, 1, -1], np.float32)
    check(turned, [0, None, 2, 3, 4, 5, None, 1, 0], processor)
    lying = WINDOWS.copy()
    lying[:, :, :, [0, 2]] = 0.0  # no line from right to left is seen from above
    check(lying, [None] * 9, processor)


@pytest.mark.parametrize("heads", [1, 4])
def test_nets_of_other_sizes_have_a_kernel_too(heads: int) -> None:
    config = NetConfig(
        encoder_hidden=128, encoder_heads=heads, categories=64, canonical_heading=heads == 1
    )
    net = make_net(config)
    base = find_packed(net)
    assert base is not None
    made = forecast_fused(base, WINDOWS, [None] * 9).displacement
    given_ = torch.from_numpy(WINDOWS)
    assert np.abs(made - (net(given_) - given_[:, -1:]).numpy()).max() < 1e-5


@pytest.mark.parametrize("processor", PROCESSORS)
@pytest.mark.parametrize("name", NETS)
@pytest.mark.parametrize("count", range(1, 10))
def test_blocks_of_any_size_are_encoded_alike(name: str, count: int, processor: str) -> None:
    net, base = NETS[name], find_packed(NETS[name])
    assert base is not None
    assert name.removeprefix("symmetric ") == base.encoder_kind
    assert name.startswith("symmetric") == base.is_folded
    made = forecast_fused(base, WINDOWS[:count], [None] * count, processor=processor).displacement
    given_ = torch.from_numpy(WINDOWS[:count])
    assert np.abs(made - (net(given_) - given_[:, -1:]).numpy()).max() < 1e-5


def test_a_window_or_a_decoder_that_is_not_finite_harms_no_other_row() -> None:
    base = find_packed(NET)
    assert base is not None
    windows = WINDOWS[:6].copy()
    windows[1, 3, 4] = np.nan
    broken = copy.deepcopy(NET.decoder)
    broken.cell.weight_hh[3, 4] = torch.nan
    people = [None, PACKED[2], PACKED[3], PackedPerson(pack_decoder(broken), None), None, PACKED[0]]
    made = forecast_fused(base, windows, people)
    finite = np.isfinite(made.displacement).all(axis=(1, 2, 3))
    assert finite.tolist() == [True, False, True, False, True, True]
    assert np.isnan(made.share[1])
    assert np.isfinite(made.fastest).tolist() == finite.tolist()


def test_sixteen_bits_are_kept_only_where_nothing_is_lost() -> None:
    assert [find_packed_kind(person.decoder) for person in PACKED[:3]] == list(KINDS)
    full, half, brief = (person.decoder.nbytes for person in PACKED[:3])
    assert max(half, brief) < 0.6 * full
    assert pack_decoder(PEOPLE[0].decoder, kind="float16").nbytes == half
    rounded = copy.deepcopy(PEOPLE[0].decoder)
    round_matrices(rounded)
    assert find_packed_kind(pack_decoder(rounded)) == "bfloat16"
    rounded.start.weight[0, 0] = 1 + 2**-20
    assert find_packed_kind(pack_decoder(rounded)) == "float32"


def test_nets_of_another_kind_or_size_have_none() -> None:
    assert find_packed(make_net(SMALL)) is None

    class Other(Decoder):
        pass

    net = make_net()
    net.decoder.__class__ = Other
    assert find_packed(net) is None


def test_without_a_kernel_nothing_is_laid_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fused, "PROCESSORS", {})
    assert find_packed(make_net()) is None
    base = find_packed(NET)
    assert base is not None
    with pytest.raises(RuntimeError, match="no kernel"):
        forecast_fused(base, WINDOWS, [None] * 9)


def rename(packed: Packed, kind: str) -> Packed:
    """Say that matrices are kept in another kind of numbers than they are."""
    renamed = packed.copy()
    renamed.view(np.int32)[1] = KINDS.index(kind) if kind in KINDS else len(KINDS)
    return renamed


def test_what_does_not_fit_is_refused_before_anything_is_read() -> None:
    base = find_packed(NET)
    assert base is not None
    cut = PackedPerson(PACKED[0].decoder[:-4], None)
    with pytest.raises(ValueError, match="decoder"):
        forecast_fused(base, WINDOWS[:1], [cut])
    for encoder in (base.encoder[:-4], base.encoder[:32], base.encoder[64:]):
        with pytest.raises(ValueError, match="encoder"):
            forecast_fused(replace(base, encoder=encoder), WINDOWS[:1], [None])
    for kind in ("bfloat16", "float16", "nothing"):
        with pytest.raises(ValueError, match="encoder"):
            forecast_fused(replace(base, encoder=rename(base.encoder, kind)), WINDOWS[:1], [None])
    folded = base.encoder.copy()
    folded.view(np.int32)[2] = 1  # its hidden matrices would have another size
    with pytest.raises(ValueError, match="encoder"):
        forecast_fused(replace(base, encoder=folded), WINDOWS[:1], [None])
    with pytest.raises(ValueError, match="gate"):
        forecast_fused(base, WINDOWS[:1], [PackedPerson(PACKED[0].decoder, PACKED[0].decoder)])
    person = PACKED[1]
    assert person.correction is not None
    for correction in (person.correction[:-2], person.decoder, person.correction[:64]):
        with pytest.raises(ValueError, match="correction"):
            forecast_fused(base, WINDOWS[:1], [replace(person, correction=correction)])
    for other in (replace(person, gate=None), replace(person, gate=pack_gate(SMALL_GATE))):
        with pytest.raises(ValueError, match="gate"):
            forecast_fused(base, WINDOWS[:1], [other])
    with pytest.raises(ValueError, match="size"):
        forecast_fused(replace(base, horizon=14), WINDOWS[:1], [None])
    with pytest.raises(ValueError, match="size"):
        forecast_fused(base, WINDOWS[:2, 1:], [None, None])
    with pytest.raises(KeyError):
        forecast_fused(base, WINDOWS[:1], [None], processor="abacus")


@pytest.mark.skipif(KERNEL is None, reason="no kernel was built")
@pytest.mark.parametrize(
    ("place", "value"), [(11, 10**6), (19, 10**6), (51, 10**6), (51, -1), (16, 0), (16, -(2**31))]
)
def test_a_shape_that_points_outside_of_the_skeleton_is_refused(place: int, value: int) -> None:
    base = find_packed(NET)
    assert KERNEL is not None
    assert base is not None
    KERNEL.check(base.shape)
    shape = np.frombuffer(base.shape, np.int32).copy()
    shape[place] = value
    with pytest.raises(ValueError, match="kernel"):
        KERNEL.check(shape.tobytes())


@pytest.mark.skipif(KERNEL is None, reason="no kernel was built")
@pytest.mark.parametrize(
    ("joints", "root"), [(-20, 0), (-(2**31), 0), (1431655766, 0), (3, 3), (2, 0)]
)
def test_poses_of_another_size_are_refused(joints: int, root: int) -> None:
    assert KERNEL is not None
    with pytest.raises(ValueError, match="fit"):
        KERNEL.find_fastest(np.zeros(9), joints, root)
