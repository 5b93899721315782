"""What was handed over to be sent: frames in their order, and marks between them.

Kept are the frames of the last 0.6 s, which a new connection needs, and those of a recording that
the service has not stored yet. What is older and was never sent is dropped: the newest wins.
"""

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

HISTORY_S = 0.6
KEEP_ITEMS = 7200
"""A minute at 120 Hz: a recording without a stream is closed by the service after as long."""
FRESH_S = 0.1
"""A frame that was never sent and is not older than this is answered by the next connection."""
_SLACK_S = 1e-6


@dataclass(slots=True)
class Frame:
    """One frame.

    Attributes:
        seq: its number.
        t: capture time on the clock of the frames, seconds.
        joints: [J, 3] metres, NaN where missing; None without the person.
        confidence: [J], None if not given.
        offered_at: when it was handed over, on the monotonic clock, seconds.
        recorded: whether it belongs to a recording.
        era: how often the frame of reference or the clock had changed before it.
        sent: whether any connection has taken it.
        replay: whether it is sent again, to be answered by nobody.
    """

    seq: int
    t: float
    joints: npt.NDArray[np.float32] | None
    confidence: npt.NDArray[np.float32] | None
    offered_at: float
    recorded: bool
    era: int
    sent: bool = False
    replay: bool = False


@dataclass(slots=True)
class Mark:
    """A message that has its place among the frames, such as the begin of a clip."""

    kind: str
    after_seq: int
    fields: dict[str, object] = field(default_factory=dict)
    sent: bool = False


class Tape:
    """Frames and marks in the order in which they were handed over."""

    def __init__(self) -> None:
        self.unsent = 0
        self.unrecorded = 0
        self._items: list[Frame | Mark] = []
        self._base = self._next = 0
        self._era = 0
        self._newest: Frame | None = None
        self._opening: Mark | None = None
        self._opening_at = 0
        self._opening_sent = False
        self._stored_seq: int | None = None

    def __len__(self) -> int:
        return len(self._items)

    def add(
        self,
        seq: int,
        t: float,
        joints: npt.NDArray[np.float32] | None,
        confidence: npt.NDArray[np.float32] | None,
        *,
        now: float,
        recorded: bool,
    ) -> None:
        """Append a frame; shapes and units as in `Frame`."""
        self._newest = Frame(seq, t, joints, confidence, now, recorded, self._era)
        self._items.append(self._newest)
        self._prune()

    def mark(self, kind: str, after_seq: int, **fields: object) -> None:
        """Append a message that has its place after the frame `after_seq`."""
        self._items.append(Mark(kind, after_seq, fields))

    def cut(self) -> None:
        """Let no connection see earlier frames again: their frame of reference or clock is gone."""
        self._era += 1

    def open_recording(self, kind: str, **fields: object) -> None:
        """Begin to keep recorded frames; every connection is told by this message first."""
        self._opening = Mark(kind, -1, fields)
        self._opening_at = self._base + len(self._items)
        self._opening_sent, self._stored_seq = False, None

    def reopen_recording(self, kind: str, **fields: object) -> None:
        """Say by another message that the recording goes on; nothing is said at once."""
        if self._opening is not None:
            self._opening = Mark(kind, -1, fields)

    def repeat_opening(self) -> None:
        """Say once more that the recording goes on."""
        self._opening_sent = False

    def confirm(self, stored_seq: int | None) -> None:
        """Forget recorded frames that are stored."""
        if stored_seq is not None:
            self._stored_seq = max(stored_seq, -1 if self._stored_seq is None else self._stored_seq)
            self._prune()

    def close_recording(self) -> None:
        """Keep nothing for a recording any more."""
        self._opening = None
        for item in self._items:
            if isinstance(item, Frame):
                item.recorded = False
        self._prune()

    def rewind(self, now: float) -> None:
        """Begin a new connection: what is kept is sent again."""
        self._items = [item for item in self._items if self._is_due(item, now)]
        self._base = self._next = 0
        self._opening_at = self._find_opening()
        self._opening_sent = False
        for item in self._items:
            if isinstance(item, Frame):
                is_news = item is self._newest and not item.sent
                item.replay = not (is_news and now - item.offered_at <= FRESH_S)

    def take(self) -> Frame | Mark | None:
        """Give what is to be sent next, None where nothing is."""
        if self._opening is not None and not self._opening_sent and self._next >= self._opening_at:
            self._opening_sent = True
            return self._opening
        while (index := self._next - self._base) < len(self._items):
            item = self._items[index]
            self._next += 1
            if self._is_kept(item):
                item.sent = True
                return item
            self.unsent += not item.sent
        return None

    def _is_due(self, item: Frame | Mark, now: float) -> bool:
        if isinstance(item, Mark) or self._is_unstored(item):
            return self._is_kept(item)
        return self._is_kept(item) and now - item.offered_at <= 2 * HISTORY_S

    def _is_kept(self, item: Frame | Mark) -> bool:
        if isinstance(item, Mark):
            return not item.sent or self._is_unstored(item)
        if self._is_unstored(item):
            return True
        newest = self._newest
        return (
            newest is not None
            and item.era == self._era
            and newest.t - item.t <= HISTORY_S + _SLACK_S
        )

    def _is_unstored(self, item: Frame | Mark) -> bool:
        if self._opening is None:
            return False
        stored = -1 if self._stored_seq is None else self._stored_seq
        if isinstance(item, Mark):
            return item.after_seq >= stored
        return item.recorded and item.seq > stored

    def _find_opening(self) -> int:
        """Tell before which item the recording began."""
        for index, item in enumerate(self._items):
            if isinstance(item, Mark) or item.recorded:
                return index
        return len(self._items)

    def _prune(self) -> None:
        while self._items and (len(self._items) > KEEP_ITEMS or not self._is_kept(self._items[0])):
            item = self._items.pop(0)
            self.unrecorded += isinstance(item, Frame) and self._is_unstored(item)
            self.unsent += not item.sent
            self._base += 1
        self._next = max(self._next, self._base)
