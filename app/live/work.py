"""What goes into the engine and what comes out: plain values, free of torch.

What is made anew for every frame is a `Struct` here and in the modules around: a frozen dataclass
takes ten times as long to make.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32
from msgspec import Struct

from app.domain.motion import RequestedVersion, Timing, VersionStamp
from models.baselines import Forecaster


@dataclass(frozen=True, slots=True)
class Choice:
    """What shall answer.

    Attributes:
        stamp: what its answers say of it.
        forecaster: a personal decoder, None for the base.
        reason: why it is in use since lately.
        previous: what answers where this fails, loaded once that is known to happen; the base is
            behind every personal version anyway.
        bones: of the person that it was made for, as `app.domain.body.measure_bones` gives them;
            None if that is not known. The base answers whoever looks like somebody else.
    """

    stamp: VersionStamp
    forecaster: Forecaster | None = None
    reason: str = ""
    previous: "Choice | None" = None
    bones: tuple[float, ...] | None = None


class EngineRequest(Struct, frozen=True):
    """One window to forecast.

    Attributes:
        window: metres, net skeleton, y up.
        version: the weights asked for.
        coverage: probability that the radius is to have.
        choice: what that means for this user; None for the base.
    """

    window: Float[np.ndarray, "15 20 3"]
    version: RequestedVersion
    coverage: float
    choice: Choice | None = None


class EngineResult(Struct, frozen=True):
    """One forecast.

    Attributes:
        displacement: metres from the last observed pose; net skeleton, y up; always finite.
        radius: metres, None where it is not calibrated.
        coverage: probability that the radius has.
        version: what really answered.
        timing: where the time went.
        flags: quality flags of how the forecast came about.
    """

    displacement: Float32[np.ndarray, "15 20 3"]
    radius: Float32[np.ndarray, "15 20"] | None
    coverage: float
    version: VersionStamp
    timing: Timing
    flags: tuple[str, ...]
