"""Whose weights answer: today the base for everybody."""

from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, Float32

from app.domain.errors import VersionUnavailableError
from app.domain.motion import RequestedVersion, VersionStamp
from models.baselines import Forecaster
from models.skeleton import HIP_CENTER
from models.uncertainty import RadiusTable


class Decoders:
    """The weights that this process can forecast with.

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
        """Tell which weights answer a request for a version.

        Raises:
            VersionUnavailableError: a personal version; a pinned one is never replaced.
        """
        if requested not in {"active", "base", 0}:
            raise VersionUnavailableError(f"There is no version {requested}.")
        return VersionStamp(number=0, kind="base", sha256=self.base_sha256, requested=requested)

    def forecast(
        self, windows: Float[np.ndarray, "batch observe 20 3"]
    ) -> Float32[np.ndarray, "batch horizon 20 3"]:
        """Forecast displacements (metres) from the last observed pose of each window.

        Everything is taken relative to the last hip centre in float64 before it becomes float32,
        so that the place of the person in the room costs no precision.
        """
        centred = windows - windows[:, -1:, HIP_CENTER : HIP_CENTER + 1]
        given = torch.from_numpy(centred.astype(np.float32))
        with torch.inference_mode():
            forecast = self._base(given)
            return (forecast - given[:, -1:]).float().numpy()

    def radius(self, coverage: float) -> Float32[np.ndarray, "horizon joint"] | None:
        """Give the base's radius in metres, None where none is calibrated for this coverage."""
        return self._look_up(round(coverage, 4))

    def _compute_radius(self, coverage: float) -> Float32[np.ndarray, "horizon joint"] | None:
        if self._table is None or not 0 < coverage <= self._table.levels[-1]:
            return None
        return self._table.radius(coverage)
