"""The nets that answer: the base, and personal decoders behind its encoder."""

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, Float32
from msgspec import Struct
from torch import Tensor

from app.domain.body import BONES
from app.domain.errors import VersionUnavailableError
from app.domain.motion import Fallback, RequestedVersion, VersionStamp
from app.live.breaker import Breaker
from models.baselines import DampedVelocity, Forecaster
from models.checkpoint import Checkpoint, CheckpointError, load_checkpoint, load_personal
from models.personal import PersonalDecoder
from models.runtime.fused import find_packed
from models.runtime.mixed import NET_FAILURES, centre, forecast_mixed
from models.runtime.pack import PackedBase
from models.runtime.served import ServedDecoder, forecast_served, serve
from models.runtime.stacked import Stack, StackedDecoder, find_stack
from models.spec import MotionSpec
from models.uncertainty import RadiusTable

_PERSONAL = (ServedDecoder, StackedDecoder, PersonalDecoder)


class UnusableWeightsError(ValueError):
    """Personal weights that no decoder of this process can be built from."""


class Computed(Struct, frozen=True):
    """What a net made of one window.

    Attributes:
        displacement: metres from the last observed pose; as the net gave it, perhaps not finite.
        share: the part of the person's version in it, 0 for the base.
        fastest: its largest squared step of any joint (square metres), where that is known already.
    """

    displacement: Float32[np.ndarray, "horizon 20 3"]
    share: float
    fastest: float | None = None


Outcome = Computed | Exception
"""A forecast, or what was raised in its stead."""


class Decoders:
    """The base of this process, and what builds on it.

    Attributes:
        base_sha256: what the base's weights are called.
        breaker: which personal decoders keep failing.

    Args:
        base: the base model, or any other forecaster.
        base_sha256: what its weights are called.
        radius: its calibrated radius, if it has one.
        device: where torch stacks decoders, a GPU; None: the kernel, or torch on the processor.
    """

    def __init__(
        self,
        base: Forecaster,
        *,
        base_sha256: str,
        radius: RadiusTable | None = None,
        device: str | None = None,
    ) -> None:
        self.base_sha256 = base_sha256
        self.breaker = Breaker()
        self._base, self._table, self._device = base, radius, device
        self._other_bases: dict[str, Checkpoint] = {}
        self._look_up = lru_cache(maxsize=1024)(self._compute_radius)

    def resolve(self, requested: RequestedVersion) -> VersionStamp:
        """Tell that the base answers a request, where there is no personal version.

        Raises:
            VersionUnavailableError: a personal version; a pinned one is never replaced.
        """
        if requested not in {"active", "base", 0}:
            raise VersionUnavailableError(f"There is no version {requested}.")
        return self.stamp_base(requested)

    def stamp_base(
        self, requested: RequestedVersion, *, fallback: Fallback | None = None
    ) -> VersionStamp:
        """Say that the base answers, and why if something else was to."""
        return VersionStamp(0, "base", self.base_sha256, requested=requested, fallback=fallback)

    def has_base(self, base_sha256: str) -> bool:
        """Tell whether decoders that were fitted on this base can be built without its file."""
        return base_sha256 == self.base_sha256 or base_sha256 in self._other_bases

    def build(
        self, blob: bytes, *, base_sha256: str | None = None, base: bytes | None = None
    ) -> Forecaster:
        """Build a personal decoder behind its base's encoder; slow, and safe on any thread.

        Args:
            blob: the decoder's weights.
            base_sha256: the base that it was fitted on, None for the one of this process.
            base: that base, as its file, where `has_base` says no.

        Raises:
            UnusableWeightsError: no weights of a decoder, of another base, no base, or malformed.
        """
        if base_sha256 is None:
            base_sha256 = self.base_sha256
        try:
            net = self._find_base(base_sha256, base)
            personal = load_personal(blob, net, base_sha256=base_sha256)
            stack = find_stack(net, self._device)
            return serve(personal) if stack is None else stack.add(personal)
        except CheckpointError as error:
            raise UnusableWeightsError(str(error)) from error
        except NET_FAILURES as error:  # a header that promises what is not there, and its kin
            raise UnusableWeightsError(f"malformed: {type(error).__name__}: {error}") from error

    def _find_base(self, base_sha256: str, blob: bytes | None) -> Forecaster:
        """Give a base's net; one that is not this process's is loaded once and kept."""
        if base_sha256 == self.base_sha256:
            return self._base
        known = self._other_bases.get(base_sha256)
        if known is None:
            if blob is None:
                raise CheckpointError(f"fitted on the base {base_sha256}, which is not here")
            loaded = load_checkpoint(blob)
            if loaded.sha256 != base_sha256 or loaded.predictor.spec != MotionSpec():
                raise CheckpointError(f"not the base {base_sha256}, or one of another shape")
            known = self._other_bases.setdefault(base_sha256, loaded)
        return known.predictor

    def forecast(
        self, windows: Float[np.ndarray, "batch observe 20 3"]
    ) -> Float32[np.ndarray, "batch horizon 20 3"]:
        """Forecast displacements (metres) from the last observed pose of each window by the base.

        Args:
            windows: metres, net skeleton, y up.
        """
        stack = find_stack(self._base, self._device)
        if stack is not None:
            return stack.forecast(windows, [None] * len(windows))[0]
        packed = find_packed(self._base)
        if packed is not None:
            return forecast_served(packed, windows, [None] * len(windows)).displacement
        given = centre(windows)
        with torch.inference_mode():
            return _to_displacement(self._base(given), given)

    def forecast_each(
        self,
        windows: Float[np.ndarray, "batch observe 20 3"],
        forecasters: Sequence[Forecaster | None],
    ) -> list[Outcome]:
        """Forecast each window by its own version; the encoder runs once for all of them.

        Args:
            windows: metres, net skeleton, y up.
            forecasters: for each window a personal decoder, None for the base.

        Returns:
            For each window the forecast, or what was raised in its stead.
        """
        outcomes: dict[int, Outcome] = {}
        for rows in self._split(forecasters):
            is_all = len(rows) == len(windows)
            try:
                made = self._compute(
                    windows if is_all else windows[rows], [forecasters[row] for row in rows]
                )
            except NET_FAILURES as error:
                made = [error for _ in rows]
            outcomes |= zip(rows, made, strict=True)
        return [outcomes[row] for row in range(len(windows))]

    def glide(
        self, window: Float[np.ndarray, "observe 20 3"], *, horizon: int
    ) -> Float32[np.ndarray, "horizon 20 3"]:
        """Let a person slow down from where they are: displacements without any weights."""
        given = torch.from_numpy(window[None])
        glided = DampedVelocity(horizon)(given).double() - given[:, -1:]
        return np.asarray(glided[0].float().numpy())

    def radius(
        self, coverage: float, *, share: float = 0.0, forecaster: Forecaster | None = None
    ) -> Float32[np.ndarray, "horizon joint"] | None:
        """Give the radius in metres, None where none is calibrated for this.

        A base's table holds for that base. A personal version may say how much wider or narrower
        its own is; as much of that counts as the version has a share in the forecast.

        Args:
            coverage: probability that the radius is to have.
            share: the part of the person's version in the forecast.
            forecaster: that decoder.
        """
        scale = 1.0 if share == 0 else _read_radius_scale(forecaster)
        if scale is None:
            return None
        factor = 1 + share * (scale - 1)
        return self._look_up(round(coverage, 4), self._name_base(forecaster), factor)

    def _name_base(self, forecaster: Forecaster | None) -> str:
        """Tell what the base is called that a forecaster runs on."""
        if isinstance(forecaster, _PERSONAL) and forecaster.base is not self._base:
            for sha256, other in tuple(self._other_bases.items()):
                if other.predictor is forecaster.base:
                    return sha256
        return self.base_sha256

    def _compute_radius(
        self, coverage: float, base_sha256: str, factor: float
    ) -> Float32[np.ndarray, "horizon joint"] | None:
        other = self._other_bases.get(base_sha256)
        table = self._table if other is None else other.radius
        if table is None or not 0 < coverage <= table.levels[-1]:
            return None
        return np.float32(factor) * table.radius(coverage)

    def _compute(
        self,
        windows: Float[np.ndarray, "batch observe 20 3"],
        forecasters: Sequence[Forecaster | None],
    ) -> list[Outcome]:
        """Compute one part of a batch: everybody behind one base's encoder, or one forecaster."""
        first = next((one for one in forecasters if one is not None), None)
        net = first.base if isinstance(first, _PERSONAL) else first or self._base
        stack = find_stack(net, self._device)
        if stack is not None and not isinstance(first, PersonalDecoder):
            return _forecast_stacked(stack, windows, forecasters)
        packed = find_packed(net)
        if packed is not None and not isinstance(first, PersonalDecoder):
            return _forecast_served(packed, windows, forecasters)
        given = centre(windows)
        with torch.inference_mode():
            if isinstance(first, PersonalDecoder):
                return _forecast_mixed(first, given, forecasters)
            displacement = _to_displacement((first or self._base)(given), given)
        return [Computed(one, share=float(first is not None)) for one in displacement]

    def _split(self, forecasters: Sequence[Forecaster | None]) -> list[list[int]]:
        """Split a batch into the rows that are computed together.

        A base and what runs behind its encoder are one part; any other forecaster has its own, and
        so has what is not laid out for the kernel though its base is.
        """
        parts: dict[tuple[int, bool], list[int]] = {}
        for row, one in enumerate(forecasters):
            net = one.base if isinstance(one, _PERSONAL) else one or self._base
            is_left = isinstance(one, PersonalDecoder) and find_packed(net) is not None
            parts.setdefault((id(net), is_left), []).append(row)
        return list(parts.values())


def _forecast_served(
    packed: PackedBase,
    windows: Float[np.ndarray, "batch observe 20 3"],
    forecasters: Sequence[Forecaster | None],
) -> list[Outcome]:
    """Forecast by a base and by all that run behind its encoder, in one call of the kernel."""
    decoders = [one if isinstance(one, ServedDecoder) else None for one in forecasters]
    made = forecast_served(packed, windows, decoders)
    rows = zip(made.displacement, made.share.tolist(), made.fastest.tolist(), strict=True)
    return [Computed(*row) for row in rows]


def _forecast_stacked(
    stack: Stack,
    windows: Float[np.ndarray, "batch observe 20 3"],
    forecasters: Sequence[Forecaster | None],
) -> list[Outcome]:
    """Forecast by a base and by all that run behind its encoder, on a device."""
    decoders = [one if isinstance(one, StackedDecoder) else None for one in forecasters]
    made = stack.forecast(windows, decoders)
    return [Computed(*row) for row in zip(made[0], made[1].tolist(), strict=True)]


def _forecast_mixed(
    first: PersonalDecoder,
    given: Float[Tensor, "batch observe 20 3"],
    forecasters: Sequence[Forecaster | None],
) -> list[Outcome]:
    """Forecast by the base of one personal decoder, and by all that run behind its encoder."""
    personal = [one if isinstance(one, PersonalDecoder) else None for one in forecasters]
    mixed = forecast_mixed(first.base, given, personal)
    displacement = _to_displacement(mixed.frames, given)
    return [
        mixed.failures.get(row) or Computed(displacement[row], float(mixed.share[row]))
        for row in range(len(given))
    ]


def _to_displacement(
    frames: Float[Tensor, "batch horizon 20 3"], given: Float[Tensor, "batch observe 20 3"]
) -> Float32[np.ndarray, "batch horizon 20 3"]:
    return (frames - given[:, -1:]).float().numpy()


def read_bones(forecaster: Forecaster) -> tuple[float, ...] | None:
    """Give the bones of the person that a decoder was made for, None where it does not say."""
    if not isinstance(forecaster, _PERSONAL):
        return None
    bones = forecaster.metadata.get("bones")
    if not isinstance(bones, list) or len(bones) != BONES:
        return None
    if not all(isinstance(one, float) and math.isfinite(one) for one in bones):
        return None
    return tuple(bones)


def _read_radius_scale(forecaster: Forecaster | None) -> float | None:
    if not isinstance(forecaster, _PERSONAL):
        return None
    scale = forecaster.metadata.get("radius_scale")
    if not isinstance(scale, int | float) or isinstance(scale, bool):
        return None
    return float(scale) if math.isfinite(scale) and scale > 0 else None
