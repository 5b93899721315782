"""A forecast, and what it says of itself."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, cast

import numpy as np
import numpy.typing as npt
from msgspec import Struct

Severity = Literal["info", "degraded", "unsafe"]
_SEVERITIES = frozenset({"info", "degraded", "unsafe"})


class Version(Struct, frozen=True):
    """Which weights a forecast came from.

    Attributes:
        number: version of the user, 0 for the base, None for a predictor without weights.
        kind: `personal`, `base`, `damped_velocity` or `zero_velocity`.
        sha256: of the weights, None for a predictor without weights.
        requested: what was asked for: `active`, `base` or a number.
        share: the personal decoder's part of this forecast, 0 to 1.
        fallback: why it is not what was asked for, None where it is.
    """

    number: int | None
    kind: str
    sha256: str | None
    requested: str | int = "active"
    share: float = 0.0
    fallback: str | None = None


class Timing(Struct, frozen=True):
    """Where the service's time went, in milliseconds."""

    queue_ms: float
    compute_ms: float
    total_ms: float


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Forecast:
    """Where a person will be in the next half second. Copy its arrays before you change them.

    Attributes:
        frames: [15, J, 3] float32, metres, in the joints and the frame of reference of the
            observations. Every coordinate is finite.
        t: [15] float64, seconds on the clock of the observations: when each frame will be.
        radius: [15, J] float32, metres: the true joint lies within with probability `coverage`,
            per joint and frame; None where nothing was calibrated. For planning: it bounds nothing.
        coverage: probability for `radius`.
        version: which weights answered.
        quality: flags that say what is wrong with the input or the answer.
        severity: that of the worst flag. Do not use a forecast that is `unsafe`.
        filled: joints that the sensor lost and that were carried along.
        timing: where the service's time went.
        joints: names of the joints, in order; empty for a single request.
        seq: on a stream, number of the newest frame that was used, as `send` gave it; else None.
        t_observed: seconds, time of that frame on the clock of the observations.
        skipped: frames since the forecast before that a newer one superseded.
        not_due: frames since then for which none was asked (`forecast_every`).
        server_age_ms: on a stream, how old the service took the newest frame to be; else None.
    """

    frames: npt.NDArray[np.float32]
    t: npt.NDArray[np.float64]
    radius: npt.NDArray[np.float32] | None
    coverage: float
    version: Version
    quality: tuple[str, ...]
    severity: Severity
    filled: tuple[str, ...]
    timing: Timing
    t_observed: float
    joints: tuple[str, ...] = ()
    seq: int | None = None
    skipped: int = 0
    not_due: int = 0
    server_age_ms: float | None = None
    _age: Callable[[], float] = field(default=lambda: 0.0, repr=False)

    @property
    def age_s(self) -> float:
        """Seconds since its newest frame was captured, as of now, by this machine's clock.

        For a single request: seconds since it was sent.
        """
        return self._age()

    @property
    def is_usable(self) -> bool:
        """Whether the input was good enough: the severity is not `unsafe`."""
        return self.severity != "unsafe"

    def joint(self, name: str) -> int:
        """Give the index of a joint in `frames`.

        Raises:
            KeyError: this skeleton has no such joint.
        """
        try:
            return self.joints.index(name)
        except ValueError:
            raise KeyError(name) from None


def read_severity(severity: str) -> Severity:
    """Give a severity; one that is not known is taken for the worst."""
    return cast("Severity", severity) if severity in _SEVERITIES else "unsafe"


def is_distance(radius: npt.NDArray[np.float32] | None) -> bool:
    """Whether these can be radii, where there are any."""
    return radius is None or bool(np.isfinite(radius).all() and (radius >= 0).all())
