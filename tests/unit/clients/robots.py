"""Poses and forecasts for the tests of the conversions."""

import numpy as np
from kinecast_client.forecasts import Forecast, Timing, Version
from kinecast_client.samples import waving_person

NOW = 1_780_000_000.123456789


def make_forecast(frames=None, *, radius=True, severity="info", t=NOW, seq=7, **changes):
    if frames is None:
        frames = waving_person(seconds=0.5).astype(np.float32)
    fields = {
        "frames": frames,
        "t": t + np.arange(1, 16) / 30,
        "radius": np.full(frames.shape[:2], 0.07, np.float32) if radius else None,
        "coverage": 0.9,
        "version": Version(3, "personal", "ab" * 32, share=0.75),
        "quality": ("blended",),
        "severity": severity,
        "filled": (),
        "timing": Timing(0.1, 0.4, 0.6),
        "t_observed": t,
        "seq": seq,
    }
    return Forecast(**fields | changes)
