"""On real recordings the kernel gives what torch gives, in every kind of numbers."""

from pathlib import Path

import numpy as np
import pytest
import torch

from app.commands.bench.residents import vary
from models.checkpoint import SHIPPED, load_checkpoint
from models.data.clips import load_clips
from models.data.windows import cut_windows
from models.personal import PersonalDecoder
from models.rounding import round_matrices
from models.runtime.fused import PROCESSORS, PackedPerson, find_packed, forecast_fused
from models.runtime.pack import KINDS, Kind, pack_decoder
from models.spec import MotionSpec

pytestmark = pytest.mark.skipif(not PROCESSORS, reason="no kernel was built for this processor")


@pytest.mark.parametrize("processor", PROCESSORS)
@pytest.mark.parametrize("kind", KINDS)
def test_forecasts_of_real_windows_are_those_of_torch(
    utd_mhad: Path, kind: Kind, processor: str
) -> None:
    base = load_checkpoint(SHIPPED).predictor
    packed = find_packed(base)
    assert packed is not None
    clips = load_clips(utd_mhad, subjects={"2"}, trials={"2"})
    windows = cut_windows(clips, MotionSpec(), stride=12).observed
    decoder = next(vary(base.decoder))
    round_matrices(decoder)  # as every version is before it is judged and stored
    person = PackedPerson(pack_decoder(decoder, kind=kind), None)
    made = forecast_fused(packed, windows, [person] * len(windows), processor=processor)
    own = PersonalDecoder(base, decoder, None, {})
    with torch.inference_mode():
        given = torch.from_numpy(windows)
        expected = (own(given) - given[:, -1:]).numpy()
    assert len(windows) > 50
    # float16 has no room for the smallest of these weights
    assert np.abs(made.displacement - expected).max() < (1e-3 if kind == "float16" else 1e-5)
