"""Values that both routes of a forecast, the stream and the single request, speak of."""

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from typing import Literal, NamedTuple


class Severity(StrEnum):
    """How much a robot may rely on a forecast."""

    INFO = "info"
    DEGRADED = "degraded"
    UNSAFE = "unsafe"


class QualityFlag(NamedTuple):
    """One flag of a forecast: what it says and how bad that is."""

    name: str
    severity: Severity
    meaning: str


FLAGS: tuple[QualityFlag, ...] = (
    QualityFlag("filled_joints", Severity.INFO, "Some joints were missing and were carried."),
    QualityFlag("low_confidence", Severity.DEGRADED, "The sensor is unsure of several joints."),
    QualityFlag("gap", Severity.DEGRADED, "Frames are missing within the window."),
    QualityFlag("late_input", Severity.DEGRADED, "The newest frame came late."),
    QualityFlag("frozen_input", Severity.UNSAFE, "Ten poses in a row are identical."),
    QualityFlag("implausible_pose", Severity.UNSAFE, "The pose or its speed is not human."),
    QualityFlag("implausible_units", Severity.UNSAFE, "The torso's length is not in metres."),
    QualityFlag("mirrored", Severity.UNSAFE, "The sides contradict the facing of the person."),
    QualityFlag("upside_down", Severity.UNSAFE, "The head stays below the hips."),
    QualityFlag("root_relative", Severity.INFO, "Positions are relative to the hips."),
    QualityFlag("unfamiliar", Severity.INFO, "Unlike the recorded trials: mostly the base."),
    QualityFlag("not_this_person", Severity.DEGRADED, "Bone lengths are somebody else's."),
    QualityFlag("fallback", Severity.DEGRADED, "Other weights than those asked for were used."),
    QualityFlag("blended", Severity.INFO, "A mix of the personal and the base forecast."),
    QualityFlag("version_changed", Severity.INFO, "The weights changed since the last forecast."),
    QualityFlag("version_unconfirmed", Severity.DEGRADED, "The database is out of reach."),
    QualityFlag("uncalibrated", Severity.INFO, "There is no radius for the predictor used."),
)
"""Every flag that a forecast can carry. The list grows; nothing is renamed or removed."""

QUALITY: dict[str, Severity] = {flag.name: flag.severity for flag in FLAGS}

_RANK = {Severity.INFO: 0, Severity.DEGRADED: 1, Severity.UNSAFE: 2}


def worst_severity(flags: Iterable[str]) -> Severity:
    """Give the severity of a set of flags: that of the worst, ``info`` for none.

    A flag that is not in the table counts as degraded, as clients are told to take it.
    """
    severities = (QUALITY.get(flag, Severity.DEGRADED) for flag in flags)
    return max(severities, key=_RANK.__getitem__, default=Severity.INFO)


VersionKind = Literal["personal", "base", "damped_velocity", "zero_velocity"]
Fallback = Literal["previous_version", "weights_missing", "engine_error", "guard"]
RequestedVersion = Literal["active", "base"] | int


@dataclass(frozen=True, slots=True)
class VersionStamp:
    """Which weights a forecast came from.

    Attributes:
        number: version of the user, 0 for the base, None for a predictor without weights.
        kind: what sort of predictor answered.
        sha256: hex digest of the weights' file, None for a predictor without weights.
        requested: what the client asked for.
        share: the part of the person's version in this forecast, from 0 to 1; 0 for the base.
        fallback: why it is not what was asked for, None where it is.
    """

    number: int | None
    kind: VersionKind
    sha256: str | None
    requested: RequestedVersion = "active"
    share: float = 0.0
    fallback: Fallback | None = None

    def with_share(self, share: float) -> "VersionStamp":
        """Give the same weights with another share; for every forecast, so quick."""
        if share == self.share:
            return self
        return VersionStamp(
            self.number, self.kind, self.sha256, self.requested, share, self.fallback
        )

    @property
    def replaces_pinned(self) -> bool:
        """Whether something else answered in the place of a pinned personal version."""
        return self.requested not in {"active", "base", 0} and self.fallback is not None


@dataclass(frozen=True, slots=True)
class Timing:
    """Where the time of one forecast went, in milliseconds."""

    queue_ms: float
    compute_ms: float
    total_ms: float
