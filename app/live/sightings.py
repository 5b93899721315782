"""What a stream learns of the body in front of its sensor, for whoever has to tell people apart."""

from collections import deque
from collections.abc import Collection

import numpy as np
from jaxtyping import Float

from app.domain.users import Lived

ENOUGH_S = 5.0
"""What was seen for less than this is not told: a pose can make bones look longer."""
KEPT_S = 60
SLACK_S = 1e-3
_HARMLESS = frozenset({"root_relative", "not_this_person"})


class Sightings:
    """Bones of one stream's person, a second at a time, since they were last taken."""

    def __init__(self) -> None:
        self._seconds: deque[Float[np.ndarray, "8"]] = deque(maxlen=KEPT_S)
        self._counted_t = -np.inf

    def note(self, t: float, bones: Float[np.ndarray, "8"], flags: Collection[str]) -> None:
        """Count one second of a body, unless it was counted already or may be none.

        Args:
            t: its end on the client's clock.
            bones: measured over it.
            flags: of the window that ends with it.
        """
        if not _HARMLESS.issuperset(flags) or 0 <= t - self._counted_t < 1 - SLACK_S:
            return
        self._counted_t = t
        self._seconds.append(bones)

    def take(self) -> Lived | None:
        """Give what was seen since the last time, as soon as that is enough."""
        if len(self._seconds) < ENOUGH_S:
            return None
        bones = np.median(np.stack(self._seconds), axis=0)
        seconds = float(len(self._seconds))
        self._seconds.clear()
        return Lived(tuple(np.round(bones, 4).tolist()), seconds)
