"""Many versions in one batch give what each gives alone."""

import numpy as np
import pytest
import torch
from torch import Tensor

from models.data.synthetic import SyntheticPerson
from models.personal import PersonalDecoder
from models.predictor import Encoded, Predictor
from models.runtime.mixed import forecast_mixed
from tests.versions import centre, know, make_net, make_personal

BASE = make_net()
WALK = SyntheticPerson(4).record("walk", 4.0).astype(np.float64)
WAVE = SyntheticPerson(5).record("wave", 4.0).astype(np.float64)


def cut(frames: np.ndarray) -> np.ndarray:
    return np.stack([frames[i : i + 15] for i in range(0, 100, 10)])


WINDOWS = centre(np.concatenate([cut(WALK), cut(WAVE)]))
WALKER = make_personal(BASE, 1, familiarity=know(BASE, cut(WALK), half=0.6, width=0.15))
SURE = make_personal(BASE, 2)
STRANGER = make_personal(BASE, 3, familiarity=know(BASE, cut(WALK) * 40, half=0.01, width=0.001))
EVERYBODY = [None, WALKER, SURE, STRANGER]


@torch.inference_mode()
def alone(row: int, personal: PersonalDecoder | None) -> Tensor:
    forecaster = BASE if personal is None else personal
    return forecaster(WINDOWS[row : row + 1])[0]


class Counted(Predictor):
    """A net that counts how often its encoder runs."""

    def encode(self, window: Tensor) -> Encoded:
        self.encoded = getattr(self, "encoded", 0) + 1
        return super().encode(window)


@pytest.mark.parametrize("seed", range(5))
def test_every_row_is_what_its_version_gives_alone(seed: int) -> None:
    draw = np.random.default_rng(seed)
    personal = [EVERYBODY[i] for i in draw.integers(0, 4, len(WINDOWS))]
    with torch.inference_mode():
        mixed = forecast_mixed(BASE, WINDOWS, personal)
    assert not mixed.failures
    for row, version in enumerate(personal):
        assert float((mixed.frames[row] - alone(row, version)).abs().max()) < 1e-5


def test_shares_are_those_of_the_versions() -> None:
    with torch.inference_mode():
        share = forecast_mixed(BASE, WINDOWS, [WALKER] * len(WINDOWS)).share
        z = BASE.encode(WINDOWS).z
        assert torch.allclose(share, WALKER.share(z), atol=1e-5)
        assert ((share > 0) & (share < 1)).any()
        assert not forecast_mixed(BASE, WINDOWS, [None] * 19 + [STRANGER]).share.any()
        assert (forecast_mixed(BASE, WINDOWS, [SURE] * 20).share == 1).all()


def test_the_encoder_runs_once_for_everybody() -> None:
    net = Counted(config=BASE.config).eval()
    net.load_state_dict(BASE.state_dict())
    personal = [make_personal(net, seed) for seed in range(4)]
    with torch.inference_mode():
        forecast_mixed(net, WINDOWS[:5], [*personal, None])
    assert net.encoded == 1


def test_a_decoder_runs_only_where_it_has_a_share() -> None:
    sizes: list[int] = []
    spied = make_personal(BASE, 3, familiarity=STRANGER.familiarity)
    spied.decoder.register_forward_hook(lambda _, given, __: sizes.append(len(given[0])))
    of_base: list[int] = []
    handle = BASE.decoder.register_forward_hook(lambda _, given, __: of_base.append(len(given[0])))
    try:
        with torch.inference_mode():
            forecast_mixed(BASE, WINDOWS[:3], [spied, SURE, spied])
            forecast_mixed(BASE, WINDOWS[:2], [SURE, SURE])
    finally:
        handle.remove()
    assert sizes == []
    assert of_base == [2]


def test_a_decoder_that_raises_harms_no_other_row() -> None:
    broken = make_personal(BASE, 6)
    broken.decoder.register_forward_pre_hook(lambda *_: (_ for _ in ()).throw(RuntimeError("no")))
    blind = make_personal(BASE, 7, familiarity=know(BASE, cut(WALK)))
    object.__setattr__(blind.familiarity, "mean", torch.zeros(3))
    with torch.inference_mode():
        mixed = forecast_mixed(BASE, WINDOWS[:4], [SURE, broken, None, blind])
    assert set(mixed.failures) == {1, 3}
    for row, version in ((0, SURE), (2, None)):
        assert float((mixed.frames[row] - alone(row, version)).abs().max()) < 1e-5


def test_a_share_that_is_no_number_is_no_forecast() -> None:
    lost = make_personal(BASE, 8, familiarity=know(BASE, cut(WALK)))
    lost.familiarity.mean.fill_(float("nan"))
    with torch.inference_mode():
        mixed = forecast_mixed(BASE, WINDOWS[:2], [lost, None])
    assert mixed.frames[0].isnan().all()
    assert mixed.frames[1].isfinite().all()
