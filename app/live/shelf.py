"""The personal decoders that are in memory: those in use, and those that were in use last."""

from collections import OrderedDict
from collections.abc import Collection
from weakref import WeakValueDictionary

from models.baselines import Forecaster

KEPT = 256
"""Decoders that stay while nobody uses them, of about 1 MB each."""


class Shelf:
    """Decoders by the digests of their weights.

    Whatever somebody holds is found here, however many that are; so nobody's decoder is built
    twice. Of the others the newest stay, in case they are asked for again.
    """

    def __init__(self) -> None:
        self._alive: WeakValueDictionary[str, Forecaster] = WeakValueDictionary()
        self._kept: OrderedDict[str, Forecaster] = OrderedDict()

    def list_digests(self) -> frozenset[str]:
        """List what is here; the engine's thread may let go of something meanwhile."""
        return frozenset(one.key for one in self._alive.valuerefs())

    def find(self, sha256: str) -> Forecaster | None:
        """Give a decoder, which is in use then, None where it is not here."""
        forecaster = self._alive.get(sha256)
        if forecaster is not None:
            self._kept[sha256] = forecaster
            self._kept.move_to_end(sha256)
        return forecaster

    def put(self, sha256: str, forecaster: Forecaster) -> None:
        """Add a decoder that is in use."""
        self._alive[sha256] = self._kept[sha256] = forecaster

    def drop(self, sha256: str) -> None:
        """Find a decoder no more; who holds it may go on with it."""
        self._alive.pop(sha256, None)
        self._kept.pop(sha256, None)

    def tidy(self, used: Collection[str]) -> None:
        """Let go of what has been idle for longest, where there is too much of it.

        Args:
            used: what is in use for certain, and does not count.
        """
        idle = [sha256 for sha256 in self._kept if sha256 not in used]
        for sha256 in idle[: max(0, len(idle) - KEPT)]:
            del self._kept[sha256]
