"""What answers each window: the version asked for, or the next rung down where that fails.

Active version, the version before it, base, a damped velocity, standing still. Every forecast gets
an answer at once and says who gave it; one that fails costs the others of its batch nothing.
"""

import time
import traceback
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import structlog
from jaxtyping import Float32
from msgspec import Struct

from app.domain.motion import Fallback, VersionKind, VersionStamp
from app.live.decoders import Computed, Decoders, Outcome
from app.live.guard import GuardRules, is_possible, measure_fastest
from app.live.telemetry import Telemetry
from app.live.work import Choice, EngineRequest
from models.spec import MotionSpec

FAMILIAR = 0.5
"""Share below which a window counts as unlike the recorded trials."""
SHARE_DIGITS = 4
LOG_EVERY_S = 10.0

log = structlog.get_logger(__name__)


class Landing(Struct, frozen=True):
    """What answered a window.

    Attributes:
        displacement: metres from the last observed pose; finite and possible.
        version: who gave it.
        radius: metres, None where it is not calibrated.
        flags: quality flags of how it came about.
    """

    displacement: Float32[np.ndarray, "15 20 3"]
    version: VersionStamp
    radius: Float32[np.ndarray, "15 20"] | None
    flags: tuple[str, ...]


@dataclass(slots=True)
class _Climb:
    """A window on its way down.

    Attributes:
        request: the window.
        rungs: what is still to be tried, the best first.
        reason: why the first one did not answer.
        landing: the answer.
    """

    request: EngineRequest
    rungs: list[Choice]
    reason: Fallback | None = None
    landing: Landing | None = None

    def step_down(self, reason: Fallback) -> None:
        """Give the present rung up."""
        self.rungs.pop(0)
        self.reason = self.reason or reason


class Ladder:
    """Forecasts batches, whatever their versions, and replaces what fails.

    Args:
        decoders: the weights.
        telemetry: where to count.
        rules: what a forecast may look like.
        spec: shape of the task.
    """

    def __init__(
        self, decoders: Decoders, *, telemetry: Telemetry, rules: GuardRules, spec: MotionSpec
    ) -> None:
        self._decoders, self._telemetry = decoders, telemetry
        self._rules, self._spec = rules, spec
        self._last_log = -LOG_EVERY_S

    def forecast(self, requests: Sequence[EngineRequest]) -> list[Landing]:
        """Answer every window."""
        climbs = [_Climb(request, self._list_rungs(request)) for request in requests]
        while pending := [climb for climb in climbs if climb.landing is None and climb.rungs]:
            self._try(pending)
        return [climb.landing or self._glide(climb) for climb in climbs]

    def report(self, error: BaseException) -> None:
        """Tell operators what the nets raise, now and then."""
        now = time.perf_counter()
        if now - self._last_log >= LOG_EVERY_S:
            self._last_log = now
            # no exc_info: renderers that print local variables would log whole poses
            trace = "".join(traceback.format_exception(error))
            log.error("the net failed; forecasts are fallbacks", trace=trace)

    def _list_rungs(self, request: EngineRequest) -> list[Choice]:
        """List who may answer; nobody stands in for a pinned version."""
        first = request.choice or Choice(self._decoders.resolve(request.version))
        if first.forecaster is None or request.version != "active":
            return [first]
        base = Choice(self._decoders.stamp_base(request.version))
        return [first, base] if first.previous is None else [first, first.previous, base]

    def _try(self, climbs: Sequence[_Climb]) -> None:
        """Have one rung of each answer, or step down."""
        ready = [climb for climb in climbs if self._pass_over(climb)]
        if not ready:
            return
        windows = np.stack([climb.request.window for climb in ready])
        forecasters = [climb.rungs[0].forecaster for climb in ready]
        outcomes = self._decoders.forecast_each(windows, forecasters)
        for i, outcome in enumerate(outcomes):
            if isinstance(outcome, Exception) and len(ready) > 1:  # perhaps a neighbour's fault
                alone = self._decoders.forecast_each(windows[i : i + 1], forecasters[i : i + 1])
                outcomes[i] = alone[0]
        for climb, outcome in zip(ready, outcomes, strict=True):
            self._judge(climb, outcome)

    def _pass_over(self, climb: _Climb) -> bool:
        """Step down from decoders that keep failing; tells whether there is anything to try."""
        while climb.rungs:
            rung = climb.rungs[0]
            blocked = None
            if rung.forecaster is not None:
                blocked = self._decoders.breaker.blocks(rung.stamp.sha256)
            if blocked is None:
                return True
            climb.step_down(blocked)
        return False

    def _judge(self, climb: _Climb, outcome: Outcome) -> None:
        """Take a forecast if it is possible."""
        if isinstance(outcome, Computed) and self._can_follow(outcome):
            self._land(climb, outcome)
            return
        reason: Fallback = "guard"
        if isinstance(outcome, Exception):
            self.report(outcome)
            reason = "engine_error"
        is_base_alone = isinstance(outcome, Computed) and outcome.share == 0
        if not is_base_alone:
            self._note_failure(climb.rungs[0], reason)
        climb.step_down(reason)

    def _note_failure(self, rung: Choice, reason: Fallback) -> None:
        sha256 = rung.stamp.sha256
        if rung.forecaster is None or sha256 is None:
            return
        if self._decoders.breaker.fail(sha256, reason):
            self._telemetry.count_trip()
            log.warning("a decoder keeps failing and is passed over", sha256=sha256, why=reason)

    def _land(self, climb: _Climb, computed: Computed) -> None:
        """Let a rung be the answer; one that is not the first says why."""
        rung, coverage = climb.rungs[0], climb.request.coverage
        stamp, share = rung.stamp, round(computed.share, SHARE_DIGITS)
        if rung.forecaster is None:
            stamp = replace(stamp, fallback=climb.reason or stamp.fallback)
        else:
            stamp = stamp.with_share(share)
            if share and stamp.sha256 is not None:
                self._decoders.breaker.succeed(stamp.sha256)
        radius = self._decoders.radius(coverage, share=share, forecaster=rung.forecaster)
        flags = _list_flags(stamp, is_calibrated=radius is not None)
        climb.landing = Landing(computed.displacement, stamp, radius, flags)

    def _glide(self, climb: _Climb) -> Landing:
        """Let the person slow down; where even that is impossible, let them stand still."""
        kind: VersionKind = "damped_velocity"
        horizon = self._spec.horizon
        displacement = self._decoders.glide(climb.request.window, horizon=horizon)
        if not self._can_follow(Computed(displacement, share=0.0)):
            kind, displacement = "zero_velocity", np.zeros_like(displacement)
        requested = climb.request.version
        stamp = VersionStamp(None, kind, None, requested=requested, fallback=climb.reason)
        return Landing(displacement, stamp, None, _list_flags(stamp, is_calibrated=False))

    def _can_follow(self, computed: Computed) -> bool:
        """Tell whether a person can follow a forecast."""
        fastest = computed.fastest
        if fastest is None:
            fastest = measure_fastest(computed.displacement)
        return is_possible(fastest, rate_hz=self._spec.rate_hz, rules=self._rules)


def _list_flags(stamp: VersionStamp, *, is_calibrated: bool) -> tuple[str, ...]:
    """Say how a forecast came about."""
    is_personal = stamp.kind == "personal"
    flags = {
        "fallback": stamp.fallback is not None,
        "unfamiliar": is_personal and stamp.share < FAMILIAR,
        "blended": is_personal and 0 < stamp.share < 1,
        "uncalibrated": not is_calibrated,
    }
    return tuple(name for name, holds in flags.items() if holds)
