"""The least that forecasts can take on this processor: bytes to read, and operations to do.

A person's weights are read once for each frame of a forecast, from the second level of the cache,
as they are multiplied with one vector; what many windows share is bounded by arithmetic.
"""

import time
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from models.runtime import fused
from models.runtime.fused import PROCESSORS
from models.runtime.pack import ROWS, PackedBase

TRIES = 15
_FULL, _HALF, _CALCULATE = 0, 1, 2


@dataclass(frozen=True, slots=True)
class Rates:
    """What a processor does at best.

    Attributes:
        full_gb_s: bytes read from a block as large as a decoder, in single precision.
        half_gb_s: the same in half precision, widened on the way.
        gflop_s: operations in single precision.
    """

    full_gb_s: float
    half_gb_s: float
    gflop_s: float


@dataclass(frozen=True, slots=True)
class Floor:
    """What bounds forecasts here.

    Attributes:
        encoder_bytes, decoder_bytes: of the weights in single precision that every frame reads.
        observe, horizon: frames.
        rates: for each kind of processor.
    """

    encoder_bytes: int
    decoder_bytes: int
    observe: int
    horizon: int
    rates: dict[str, Rates]

    def find(self, way: str, users: int) -> float | None:
        """Give the floor of a way of forecasting for some people, microseconds per forecast."""
        processor, _, kind = way.partition(" ")
        rates = self.rates.get(processor)
        if rates is None:
            return None
        read = self.encoder_bytes * self.observe / rates.full_gb_s / 1e3
        done = self.encoder_bytes / 2 * self.observe / rates.gflop_s / 1e3
        encoder = read if users < ROWS else max(done, read / ROWS)
        half = kind == "float16"
        speed, share = (rates.half_gb_s, 0.5) if half else (rates.full_gb_s, 1.0)
        return encoder + share * self.decoder_bytes * self.horizon / speed / 1e3

    def as_json(self) -> dict[str, Any]:
        """Give the figures for a report."""
        return asdict(self)


def measure_floor(base: PackedBase) -> Floor:
    """Measure what this processor reads and calculates at best."""
    rates = {
        name: Rates(
            full_gb_s=_measure(number, _FULL, base.decoder.nbytes),
            half_gb_s=_measure(number, _HALF, base.decoder.nbytes // 2),
            gflop_s=_measure(number, _CALCULATE, 64),
        )
        for name, number in PROCESSORS.items()
    }
    return Floor(
        encoder_bytes=base.encoder_frame_bytes,
        decoder_bytes=base.decoder_frame_bytes,
        observe=base.observe,
        horizon=base.horizon,
        rates=rates,
    )


def _measure(processor: int, kind: int, size: int) -> float:
    """Give billions of bytes read, or of operations done, in a second: the median of some tries."""
    block = np.zeros(size, np.uint8)
    times = 200_000 if kind == _CALCULATE else 60
    width = {_FULL: 4, _HALF: 2, _CALCULATE: 1}[kind]
    rates = []
    for _ in range(TRIES):
        begin = time.perf_counter()
        done = fused.probe(processor, kind, block, times)
        rates.append(done * width / (time.perf_counter() - begin) / 1e9)
    return round(float(np.median(rates)), 1)
