"""Which weights a stream's forecasts come from, and what has to be said when they change."""

from collections.abc import Callable, Collection
from dataclasses import replace

from app.domain.motion import RequestedVersion, VersionStamp
from app.live.work import Choice

Resolve = Callable[[RequestedVersion], VersionStamp]
"""Tells what the base says to a request for a version; see `Decoders.resolve`."""


def guard_choice(
    choice: Choice, flags: Collection[str], requested: RequestedVersion, *, resolve: Resolve
) -> Choice:
    """Put the base in the place of a personal version where somebody else is seen.

    A pinned version is never replaced.

    Args:
        choice: what the request means.
        flags: of the window.
        requested: the version asked for.
        resolve: tells what the base says of itself.
    """
    if requested != "active" or choice.forecaster is None or "not_this_person" not in flags:
        return choice
    return Choice(replace(resolve("active"), fallback="guard"))


class Chooser:
    """The weights of one stream.

    Args:
        resolve: tells what the base says to a request for a version.
        active: what is active for the user, None for the base.

    Attributes:
        turn: how often the weights have changed.
        unconfirmed: whether nobody can tell if they are still the right ones.
    """

    def __init__(self, resolve: Resolve, active: Choice | None) -> None:
        self.turn = 0
        self.unconfirmed = False
        self._resolve, self._active = resolve, active or Choice(resolve("active"))
        self._pinned: Choice | None = None
        self._last_kind: tuple[str, str | None] | None = None

    def choose(self, requested: RequestedVersion) -> Choice:
        """Tell what a request means.

        Raises:
            VersionUnavailableError: a version that was not loaded.
        """
        if requested == "active":
            return self._active
        if self._pinned is not None and self._pinned.stamp.requested == requested:
            return self._pinned
        return Choice(self._resolve(requested))

    def choose_for(self, flags: Collection[str], requested: RequestedVersion) -> Choice:
        """Tell what answers a window with these flags: the base, where somebody else is seen."""
        return guard_choice(self.choose(requested), flags, requested, resolve=self._resolve)

    def pin(self, choice: Choice) -> None:
        """Take a pinned version that was loaded, before it is asked for."""
        self._pinned = choice

    def switch(self, choice: Choice, *, requested: RequestedVersion) -> bool:
        """Go over to other active weights; tells whether that changes who answers."""
        changed = choice.stamp != self._active.stamp
        self._active = choice
        if not changed or requested != "active":
            return False
        self.turn += 1
        return True

    def flag(self, version: VersionStamp) -> list[str]:
        """List the quality flags of a forecast by these weights."""
        flags = []
        kind = (version.kind, version.sha256)
        if self._last_kind not in {None, kind}:
            flags.append("version_changed")
        self._last_kind = kind
        if self.unconfirmed:
            flags.append("version_unconfirmed")
        return flags
