"""What the service stores, as its routes show it. Fields that are not known here are ignored."""

from datetime import datetime
from typing import Any, Generic, TypeVar

import msgspec
from msgspec import Struct

from kinecast_client.forecasts import Version

Item = TypeVar("Item")
_FINAL = frozenset({"succeeded", "rejected", "failed", "cancelled"})


class User(Struct, frozen=True):
    """A person whose motion is forecast.

    Attributes:
        id: as it is used in every call.
        skeleton: the format of the poses.
        up: the axis that points up: `y`, `-y` or `z`.
        root_relative: whether positions are relative to the hips.
        version: what answers at the moment.
        auto_promote: whether a version that wins becomes active by itself.
        display_name: for people.
        created_at: when the user was added.
    """

    id: str
    skeleton: str
    up: str
    root_relative: bool
    version: Version
    auto_promote: bool = True
    display_name: str | None = None
    created_at: datetime | None = None


class ClipReport(Struct, frozen=True):
    """What became of one clip of a trial: `reason` and `message` say why it is not trained on."""

    ordinal: int
    frames: int
    seconds: float
    used: bool
    action: str | None = None
    reason: str | None = None
    message: str | None = None


class Trial(Struct, frozen=True):
    """A recorded trial.

    Attributes:
        id: a UUID.
        user: who was recorded.
        state: `recording`, `stored` or `cancelled`.
        clips: how many clips it has.
        frames: how many frames they have.
        seconds: how long they are.
        clips_unused: clips that are stored and not trained on.
        label: for people.
        details: what became of each clip.
        created_at: when it began.
        stored_at: when it was complete.
    """

    id: str
    user: str
    state: str
    clips: int
    frames: int
    seconds: float
    clips_unused: int = 0
    label: str | None = None
    details: tuple[ClipReport, ...] = ()
    created_at: datetime | None = None
    stored_at: datetime | None = None


class Job(Struct, frozen=True):
    """A fine-tuning job.

    Attributes:
        id: a UUID.
        user: whose decoder is trained.
        state: `queued`, `running`, `succeeded`, `rejected`, `failed` or `cancelled`.
        reason: why it is in that state.
        message: the same for people.
        trials: what it trains on; None until it starts with all that is stored then.
        attempt: how often it was started.
        progress: how far it is.
        version: number of the version that it made.
        created_at: when it was asked for.
        started_at: when it was started.
        finished_at: when it ended.
    """

    id: str
    user: str
    state: str
    reason: str | None = None
    message: str | None = None
    trials: tuple[str, ...] | None = None
    attempt: int = 0
    progress: dict[str, Any] | None = None
    version: int | None = None
    created_at: datetime | None = None
    started_at: datetime | None = None
    finished_at: datetime | None = None

    @property
    def is_over(self) -> bool:
        """Whether nothing changes any more."""
        return self.state in _FINAL


class StoredTrial(Struct, frozen=True):
    """A trial that was stored, and the job that will train on it; None where none was asked for."""

    trial: Trial
    job: Job | None = None


class PersonalVersion(Struct, frozen=True):
    """A version of a user's decoder.

    Attributes:
        number: counts from 1 for each user.
        state: `candidate`, `active`, `retired` or `rejected`.
        parent: the version that was active when it was trained.
        sha256: of its weights.
        base_sha256: of the base that it runs on.
        bytes: how large it is.
        trained_on: ids of trials.
        metrics: what the judge measured.
        purged: whether its weights were removed.
        job: id of the job that made it.
        created_at: when it was made.
        activated_at: when it last became active.
    """

    number: int
    state: str
    parent: int
    sha256: str
    base_sha256: str
    bytes: int = 0
    trained_on: tuple[str, ...] = ()
    metrics: dict[str, Any] = msgspec.field(default_factory=dict)
    purged: bool = False
    job: str | None = None
    created_at: datetime | None = None
    activated_at: datetime | None = None


class Page(Struct, Generic[Item], frozen=True):
    """A part of a list, newest first.

    Attributes:
        items: what is in it.
        next_cursor: hand it back as `cursor` for the next part; None at the end.
    """

    items: tuple[Item, ...]
    next_cursor: str | None = None


class Clip(Struct, frozen=True):
    """A clip to be uploaded: what happened without a break.

    Attributes:
        frames: [T, J, 3] metres, NaN where missing.
        t: [T] seconds; 30 Hz if absent.
        confidence: [T, J] from 0 to 1.
        action: what the person does.
    """

    frames: Any
    t: Any = None
    confidence: Any = None
    action: str | None = None
