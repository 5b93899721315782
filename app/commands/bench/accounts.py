"""What became of every frame of a stream."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from app.commands.bench.wire import Answer


@dataclass(slots=True)
class StreamLog:
    """What happened on one stream.

    Attributes:
        slow: whether its client reads slowly on purpose.
        sent: frames that were sent.
        late_s: how much later than scheduled each left.
        answers: of each forecast: scheduled instant, instant of arrival, the server's queue and
            compute time in milliseconds.
        skipped: frames that the service counted as superseded.
        covered: frames that a `waiting` stood for.
        refused: frames that an `error` answered, by code.
        lost: frames passed over without a word, and frames still unanswered at the end.
        failures: of each measured frame without a forecast that should have had one: scheduled
            instant, and when that was known.
        left: frames whose answers the client did not wait for, as it went away.
        swaps: changes of the version that the service told.
        opened_s: how long it took to come back, each time that the client had gone away.
    """

    slow: bool = False
    sent: int = 0
    late_s: list[float] = field(default_factory=list)
    answers: list[tuple[float, float, float, float]] = field(default_factory=list)
    skipped: int = 0
    covered: int = 0
    refused: dict[str, int] = field(default_factory=dict)
    lost: int = 0
    failures: list[tuple[float, float]] = field(default_factory=list)
    left: int = 0
    swaps: int = 0
    opened_s: list[float] = field(default_factory=list)


class Accounts:
    """The frames of a stream that are neither answered nor accounted for otherwise yet.

    Args:
        log: where everything ends.
    """

    def __init__(self, log: StreamLog) -> None:
        self.log = log
        self.open: dict[int, float] = {}
        self._waiting_from: int | None = None

    def note_sent(self, seq: int, due: float, now: float) -> None:
        """Note a frame that leaves now and was to leave at `due`."""
        self.open[seq] = due
        self.log.late_s.append(now - due)
        self.log.sent += 1

    def note_answer(self, answer: Answer, now: float) -> None:
        """Note a forecast, and the older frames that it passes over."""
        log, timing, open_frames = self.log, answer.timing, self.open
        due = open_frames.pop(answer.seq, None)
        if due is not None:
            log.answers.append((due, now, timing.queue_ms, timing.compute_ms))
        log.skipped += answer.skipped
        if self._waiting_from is not None or (open_frames and min(open_frames) < answer.seq):
            self._pass_over(answer, now)

    def _pass_over(self, answer: Answer, now: float) -> None:
        """Account for the older frames that were open when a forecast came."""
        log = self.log
        older = [seq for seq in self.open if seq < answer.seq]
        dues = [self.open.pop(seq) for seq in older]
        untold = max(0, len(dues) - answer.skipped)
        if self._waiting_from is not None and answer.seq > self._waiting_from:
            log.covered += untold  # a `waiting` stands for the frames up to the next forecast
            dues = dues[untold:]
            self._waiting_from = None
        else:
            log.lost += untold
        log.failures += [(due, now) for due in dues]

    def note_waiting(self, seq: int) -> None:
        """Note that from this frame on there is no forecast for a while."""
        if self._waiting_from is None:
            self._waiting_from = seq

    def note_refused(self, seq: int, code: str, now: float) -> None:
        """Note a frame that was answered by an error."""
        self.log.refused[code] = self.log.refused.get(code, 0) + 1
        due = self.open.pop(seq, None)
        if due is not None:
            self.log.failures.append((due, now))

    def leave(self) -> None:
        """Give up what is open, as the client goes away by itself."""
        self.log.left += len(self.open)
        self.open.clear()
        self._waiting_from = None

    def close(self, now: float) -> None:
        """Count what is open as lost: nothing more comes."""
        self.log.lost += len(self.open)
        self.log.failures += [(due, now) for due in self.open.values()]
        self.open.clear()


def measure_shares(logs: Sequence[StreamLog]) -> list[float]:
    """Give each stream's share of answered frames, of those that could have been answered."""
    able = [(len(log.answers), log.sent - log.covered - log.left) for log in logs]
    return [answered / frames for answered, frames in able if frames > 0]
