"""Forecasts by the kernel in `native/`, where this processor and these nets have one.

Everything about a window happens in one call without Python: placement, encoder, familiarity, the
person's decoder, the base's and its correction, and the way back to metres. Where there is no
kernel (another kind of processor, no compiler when this was installed, a net of other sizes),
`mixed.py` gives the same numbers by torch.
"""

import weakref
from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType

import numpy as np
from jaxtyping import Float, Float32

from models.decoder import Decoder
from models.encoder import Encoder
from models.latent import Latent
from models.normalize import Normalizer
from models.predictor import Predictor
from models.runtime.pack import Packed, PackedBase, pack_base
from models.structured_prediction import StructuredPrediction

_kernel: ModuleType | None
try:
    from models.runtime import _kernel  # type: ignore[attr-defined,no-redef]
except ImportError:  # not built: no compiler when this was installed
    _kernel = None
KERNEL = _kernel
"""The module in `native/`, None where it could not be built."""

PROCESSORS: dict[str, int] = dict(_kernel.processors) if _kernel is not None else {}
"""The kernels that run on this processor, the fastest first."""

_PARTS = {
    "encoder": Encoder,
    "latent": Latent,
    "decoder": Decoder,
    "normalizer": Normalizer,
}
_bases: "weakref.WeakKeyDictionary[Predictor, PackedBase | None]" = weakref.WeakKeyDictionary()


@dataclass(frozen=True, eq=False)
class PackedPerson:
    """One person's decoder, gate and correction, as the kernel reads them.

    Attributes:
        decoder: the weights.
        gate: what is familiar; None: everything.
        correction: of the base, on the points of the gate; None: none.
    """

    decoder: Packed
    gate: Packed | None
    correction: Packed | None = None


@dataclass(frozen=True, eq=False)
class FusedForecast:
    """What the kernel gave.

    Attributes:
        displacement: metres from the last observed pose, in the frame of the input.
        share: part of each row's personal decoder.
        fastest: largest squared step of any joint from frame to frame, square metres; not a number
            where a coordinate is none.
    """

    displacement: Float32[np.ndarray, "batch horizon joint 3"]
    share: Float32[np.ndarray, " batch"]
    fastest: Float32[np.ndarray, " batch"]


def find_packed(base: object) -> PackedBase | None:
    """Give a base as the kernel reads it, laid out once; None where there is no kernel for it."""
    if not isinstance(base, Predictor):
        return None
    if base not in _bases:
        _bases[base] = _pack(base)
    return _bases[base]


def forecast_fused(
    base: PackedBase,
    windows: Float[np.ndarray, "batch observe joint 3"],
    people: Sequence[PackedPerson | None],
    *,
    processor: str | None = None,
) -> FusedForecast:
    """Forecast each window by its own version; see `mixed.forecast_mixed`.

    Args:
        base: the shared net.
        windows: metres, y up.
        people: for each row whose decoder it is for; None for the base.
        processor: one of `PROCESSORS`; the fastest unless told.

    Raises:
        RuntimeError: there is no kernel.
        ValueError: sizes that do not fit each other.
    """
    if _kernel is None or not PROCESSORS:
        raise RuntimeError("there is no kernel for this processor")
    count, _, joints, _ = windows.shape
    displacement = np.empty((count, base.horizon, joints, 3), np.float32)
    share, fastest = np.empty(count, np.float32), np.empty(count, np.float32)
    _kernel.forecast(
        PROCESSORS[processor or next(iter(PROCESSORS))],
        base.shape,
        base.encoder,
        base.decoder,
        [None if person is None else person.decoder for person in people],
        [None if person is None else person.gate for person in people],
        [None if person is None else person.correction for person in people],
        np.ascontiguousarray(windows, np.float64),
        displacement,
        share,
        fastest,
    )
    return FusedForecast(displacement, share, fastest)


def probe(processor: int, kind: int, block: np.ndarray, times: int) -> float:
    """Have the kernel do nothing useful as fast as it can; see `native/probe.h`.

    Raises:
        RuntimeError: there is no kernel.
    """
    if _kernel is None:
        raise RuntimeError("there is no kernel for this processor")
    return float(_kernel.probe(processor, kind, block, times))


def _pack(base: Predictor) -> PackedBase | None:
    """Lay a net out if it is of the kind and of the sizes that the kernel was written for."""
    is_ours = all(type(getattr(base, name)) is kind for name, kind in _PARTS.items())
    if not PROCESSORS or not is_ours or type(base.decoder.predict) is not StructuredPrediction:
        return None
    packed = pack_base(base)
    return packed if _is_supported(packed) else None


def _is_supported(packed: PackedBase) -> bool:
    """Tell whether the kernel was written for nets of these sizes."""
    if _kernel is None:
        return False
    try:
        _kernel.check(packed.shape)
    except ValueError:
        return False
    return True
