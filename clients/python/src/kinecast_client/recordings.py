"""A recording as the client knows it: a state machine; the frames are on the tape."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, cast

from kinecast_client.messages import JobNote, ServiceError, TrialNews

RecordingState = Literal["starting", "recording", "ending", "stored", "cancelled", "failed"]
_OVER = frozenset({"stored", "cancelled", "failed"})
_FATAL = frozenset({"unknown_trial", "trial_conflict", "forbidden"})
"""Errors by which the service says that it records nothing."""
QUIET_S = 3.0
"""The service tells once a second how a recording stands; after this long it is asked."""


@dataclass(frozen=True, slots=True)
class RecordingStatus:
    """How a recording stands.

    Attributes:
        trial: id of the trial.
        state: `starting`, `recording`, `ending`, then `stored`, `cancelled` or `failed`.
        clip: number of the open clip from 0, None between clips.
        stored_seq: the newest frame that is in the database, None for none.
        clips_dropped: clips that lost frames in the service.
        job: the fine-tuning job, once it is stored and one was asked for.
        error: what was last wrong with it; None where nothing was.
    """

    trial: str
    state: RecordingState
    clip: int | None = None
    stored_seq: int | None = None
    clips_dropped: int = 0
    job: JobNote | None = None
    error: str | None = None

    @property
    def is_over(self) -> bool:
        """Whether nothing changes any more."""
        return self.state in _OVER


class Taking:
    """One recording: what was asked for, and what the service said of it."""

    def __init__(self, trial: str, *, now: float) -> None:
        self.status = RecordingStatus(trial, "starting")
        self.in_clip = True
        self.code = "failed"
        self._heard_at = now
        self._end: Callable[[], None] | None = None

    @property
    def takes_frames(self) -> bool:
        """Whether a frame that is handed over now belongs to it."""
        return self.in_clip and self.status.state in {"starting", "recording"}

    def end(self, ask: Callable[[], None]) -> None:
        """Ask for its end; `ask` may be called again where no answer comes."""
        self._end = ask
        self._change(state="ending")
        ask()

    def repeat_end(self) -> None:
        """Ask for its end once more, if that was asked for."""
        if self._end is not None:
            self._end()

    def hear(self, news: TrialNews, now: float) -> None:
        """Take note of what the service says of it."""
        self._heard_at = now
        state: RecordingState = self.status.state
        if news.state in {"stored", "cancelled"}:
            state = cast("RecordingState", news.state)
        elif state == "starting":
            state = "recording"
        self.status = RecordingStatus(
            trial=self.status.trial,
            state=state,
            clip=news.clip,
            stored_seq=news.stored_seq,
            clips_dropped=news.clips_dropped,
            job=news.job,
            error=self.status.error,
        )

    def fail(self, error: ServiceError) -> None:
        """Take note of an error that is about recordings."""
        is_fatal = error.code in _FATAL
        self.code = error.code
        self._change(
            state="failed" if is_fatal else self.status.state,
            error=error.message,
        )

    def is_quiet(self, now: float) -> bool:
        """Whether nothing was heard of it for suspiciously long; then it counts as heard again."""
        if self.status.is_over or now - self._heard_at <= QUIET_S:
            return False
        self._heard_at = now
        return True

    def _change(self, **changes: object) -> None:
        fields = {name: getattr(self.status, name) for name in RecordingStatus.__slots__}
        self.status = RecordingStatus(**(fields | changes))
