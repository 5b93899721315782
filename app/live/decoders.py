"""The nets that answer: the base, and personal decoders behind its encoder."""

from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, Float32

from app.domain.errors import VersionUnavailableError
from app.domain.motion import Fallback, RequestedVersion, VersionStamp
from models.baselines import Forecaster
from models.checkpoint import CheckpointError, load_personal
from models.skeleton import HIP_CENTER
from models.uncertainty import RadiusTable


class UnusableWeightsError(ValueError):
    """Personal weights that no decoder of this process can be built from."""


class Decoders:
    """The base of this process, and what builds on it.

    Args:
        base: the base model, or any other forecaster.
        base_sha256: what its weights are called.
        radius: its calibrated radius, if it has one.
    """

    def __init__(
        self, base: Forecaster, *, base_sha256: str, radius: RadiusTable | None = None
    ) -> None:
        self.base_sha256 = base_sha256
        self._base, self._table = base, radius
        self._look_up = lru_cache(maxsize=64)(self._compute_radius)

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

    def build(self, blob: bytes) -> Forecaster:
        """Build a personal decoder behind the base's encoder; slow, and safe on any thread.

        Raises:
            UnusableWeightsError: no weights of a decoder, or of another base.
        """
        try:
            return load_personal(blob, self._base, base_sha256=self.base_sha256)
        except CheckpointError as error:
            raise UnusableWeightsError(str(error)) from error

    def forecast(
        self,
        windows: Float[np.ndarray, "batch observe 20 3"],
        forecaster: Forecaster | None = None,
    ) -> Float32[np.ndarray, "batch horizon 20 3"]:
        """Forecast displacements (metres) from the last observed pose of each window.

        Everything is taken relative to the last hip centre in float64 before it becomes float32,
        so that the place of the person in the room costs no precision.

        Args:
            windows: metres, net skeleton, y up.
            forecaster: a personal decoder, None for the base.
        """
        centred = windows - windows[:, -1:, HIP_CENTER : HIP_CENTER + 1]
        given = torch.from_numpy(centred.astype(np.float32))
        with torch.inference_mode():
            forecast = (forecaster or self._base)(given)
            return (forecast - given[:, -1:]).float().numpy()

    def radius(self, coverage: float) -> Float32[np.ndarray, "horizon joint"] | None:
        """Give the base's radius in metres, None where none is calibrated for this coverage."""
        return self._look_up(round(coverage, 4))

    def _compute_radius(self, coverage: float) -> Float32[np.ndarray, "horizon joint"] | None:
        if self._table is None or not 0 < coverage <= self._table.levels[-1]:
            return None
        return self._table.radius(coverage)
