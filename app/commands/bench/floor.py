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
from models.runtime.pack import BLOCK, KINDS, Kind, PackedBase

TRIES = 15
WIDTHS: dict[str, int] = {"float32": 4, "float16": 2, "bfloat16": 2}
"""Bytes of a number."""
_CALCULATE = len(KINDS)


@dataclass(frozen=True, slots=True)
class Rates:
    """What a processor does at best.

    Attributes:
        gb_s: bytes read from a block as large as a decoder, and made floats on the way, by the kind
            of numbers.
        gflop_s: operations in single precision.
    """

    gb_s: dict[str, float]
    gflop_s: float


@dataclass(frozen=True, slots=True)
class Floor:
    """What bounds forecasts here.

    Attributes:
        encoder_bytes: of its weights, as they are kept and as often as a block of windows reads
            them.
        encoder_multiplications: of a window.
        decoder_bytes: of the weights in single precision that every frame reads.
        horizon: frames.
        rates: for each kind of processor.
    """

    encoder_bytes: int
    encoder_multiplications: int
    decoder_bytes: int
    horizon: int
    rates: dict[str, Rates]

    def find(self, way: str, users: int) -> float | None:
        """Give the floor of a way of forecasting for some people, microseconds per forecast."""
        processor, _, kind = way.partition(" ")
        rates = self.rates.get(processor)
        if rates is None or kind not in WIDTHS:
            return None
        read = self.encoder_bytes / rates.gb_s["float32"] / 1e3
        done = 2 * self.encoder_multiplications / rates.gflop_s / 1e3
        encoder = max(done, read / min(users, BLOCK))
        size = self.decoder_bytes * WIDTHS[kind] / WIDTHS["float32"]
        read = size * self.horizon / rates.gb_s[kind] / 1e3
        done = self.decoder_bytes / 2 * self.horizon / rates.gflop_s / 1e3
        return encoder + max(done, read)

    def as_json(self) -> dict[str, Any]:
        """Give the figures for a report."""
        return asdict(self)


def measure_floor(base: PackedBase) -> Floor:
    """Measure what this processor reads and calculates at best."""
    rates = {
        name: Rates(
            gb_s={kind: _measure_reading(number, kind, base.decoder.nbytes) for kind in KINDS},
            gflop_s=_measure(number, _CALCULATE, 64, 200_000),
        )
        for name, number in PROCESSORS.items()
    }
    return Floor(
        encoder_bytes=base.encoder_bytes,
        encoder_multiplications=base.encoder_multiplications,
        decoder_bytes=base.decoder_frame_bytes,
        horizon=base.horizon,
        rates=rates,
    )


def _measure_reading(processor: int, kind: Kind, full: int) -> float:
    """Give billions of bytes that are read in a second from a block as large as a decoder is."""
    size = full * WIDTHS[kind] // WIDTHS["float32"]
    return round(WIDTHS[kind] * _measure(processor, KINDS.index(kind), size, 60), 1)


def _measure(processor: int, kind: int, size: int, times: int) -> float:
    """Give billions of numbers read, or of operations done, in a second: the median of some."""
    block = np.zeros(size, np.uint8)
    rates = []
    for _ in range(TRIES):
        begin = time.perf_counter()
        done = fused.probe(processor, kind, block, times)
        rates.append(done / (time.perf_counter() - begin) / 1e9)
    return round(float(np.median(rates)), 1)
