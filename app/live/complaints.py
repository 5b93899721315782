"""What a client is told of mistakes, its own and the link's, and when they are too many."""

import math

from app.domain.errors import KinecastError, TooManyErrorsError
from app.live.accounting import ErrorBudget
from app.live.actions import Action, End, Send, describe
from app.live.frames import SNAP_S
from app.live.protocol import ErrorMessage
from app.live.telemetry import Telemetry

REPEAT_S = 1.0
"""How often a state that lasts (waiting, a wrong unit of time) is told again."""
ERRORS_MOST, ERRORS_WITHIN_S = 60, 10.0


class Complaints:
    """The errors of one stream.

    Args:
        telemetry: where to count.
    """

    def __init__(self, telemetry: Telemetry) -> None:
        self._telemetry = telemetry
        self._mistakes = ErrorBudget(most=ERRORS_MOST, within_s=ERRORS_WITHIN_S)
        self._told_at: dict[str, float] = {}

    def refuse(self, error: KinecastError, seq: int | None, now: float) -> list[Action]:
        """Tell the client of its mistake; end the stream if it makes too many."""
        actions: list[Action] = [self.tell(error, seq)]
        if not self._mistakes.spend(now):
            most, within_s = ERRORS_MOST, ERRORS_WITHIN_S
            reason = f"Over {most} errors in {within_s:g} s."
            actions.append(End(TooManyErrorsError(reason)))
        return actions

    def tell(self, error: KinecastError, seq: int | None) -> Send:
        """Tell of an error that is nobody's mistake."""
        self._telemetry.count_error(error.code)
        return Send(describe(error, seq))

    def count(self, actions: list[Action]) -> list[Action]:
        """Count the errors that somebody else wants to tell."""
        for action in actions:
            if isinstance(action, Send) and isinstance(action.message, ErrorMessage):
                self._telemetry.count_error(action.message.code)
        return actions

    def is_time(self, what: str, now: float, *, is_news: bool) -> bool:
        """Tell whether to say a thing that lasts (again)."""
        if not is_news and now - self._told_at.get(what, -math.inf) < REPEAT_S - SNAP_S:
            return False
        self._told_at[what] = now
        return True
