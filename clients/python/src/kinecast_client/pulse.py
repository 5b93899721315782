"""Is the service still there? Every frame and every ping is answered; silence is a dead link."""

import math
from typing import NamedTuple

from kinecast_client.clock import Moment, ServerClock
from kinecast_client.messages import Pong
from kinecast_client.rules import Rules


class _Ping(NamedTuple):
    id: int
    sent: Moment


class Pulse:
    """The signs of life of one connection.

    Args:
        rules: how much silence is too much.
        clock: learns from pongs; the same for all connections.
        now: when the connection was opened.
    """

    def __init__(self, rules: Rules, clock: ServerClock, now: Moment) -> None:
        self._rules, self._clock = rules, clock
        self._next_ping = now.mono
        self._asked_at: float | None = None
        self._pings = 0
        self._pinged: _Ping | None = None

    def ask(self, now: Moment) -> None:
        """Note that something was sent that will be answered."""
        if self._asked_at is None:
            self._asked_at = now.mono

    def hear(self) -> None:
        """Note that something came."""
        self._asked_at = None

    def find_silence(self, now: Moment) -> str | None:
        """Tell that the connection is dead, None where it is not."""
        if self._silent_s(now) <= self._rules.silence_s:
            return None
        return f"the service said nothing for {self._rules.silence_s:g} s"

    def ping(self, now: Moment) -> int | None:
        """Give the id of a ping that is due now, None where none is.

        Frames may go unanswered for long (`forecast_every`), so silence is asked about first.
        """
        is_quiet = self._silent_s(now) > self._rules.silence_s / 2
        if now.mono < self._next_ping and not (is_quiet and self._pinged is None):
            return None
        self._pings += 1
        self._pinged = _Ping(self._pings, now)
        self._next_ping = now.mono + self._rules.ping_every_s
        self.ask(now)
        return self._pings

    def learn(self, pong: Pong, now: Moment) -> float | None:
        """Take the answer to the newest ping and give the round trip in seconds, if it is one."""
        pinged = self._pinged
        if pinged is None or pong.id != pinged.id:
            return None
        self._pinged = None
        return self._clock.learn(sent=pinged.sent, server_t=pong.server_t, now=now)

    def _silent_s(self, now: Moment) -> float:
        return -math.inf if self._asked_at is None else now.mono - self._asked_at
