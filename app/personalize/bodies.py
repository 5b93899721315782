"""Whose body the trials of a user show, when they do not all show the same one.

Nobody but the trials themselves, and whoever was seen live under the user's name, can tell. Each
trial is one voice, what was seen live is another; where the voices are equal nothing is trained on,
and nobody's weights answer until one more trial decides.
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from app.personalize.quality import QualityRules, is_stranger

Bones = Float[np.ndarray, "8"]


@dataclass(frozen=True, slots=True)
class Bodies:
    """Who is in the trials.

    Attributes:
        person: the trials that show the user; empty where that is open.
        strangers: the trials that show somebody else; all of them where that is open.
        is_open: whether there are as many voices for one body as for another.
    """

    person: frozenset[str]
    strangers: frozenset[str]
    is_open: bool


@dataclass
class _Body:
    """Trials that look like one person."""

    trials: list[str] = field(default_factory=list)
    bones: list[Bones] = field(default_factory=list)


def tell_apart(
    trials: dict[str, list[Bones]], lived: Bones | None, *, rules: QualityRules | None = None
) -> Bodies:
    """Find out which trials show the user.

    Args:
        trials: bones of the good clips of every trial, by its name, oldest first.
        lived: bones of whoever was seen on the user's streams, None if nobody was.
        rules: how much bones may differ.
    """
    bodies = _sort(trials, rules)
    if not bodies:
        return Bodies(frozenset(), frozenset(), is_open=False)
    seen = None if lived is None else _find_seen(bodies, lived, rules)
    votes = [len(body.trials) + (body is seen) for body in bodies]
    chosen = bodies[int(np.argmax(votes))]
    if sum(vote == max(votes) for vote in votes) > 1:
        every = frozenset(trial for body in bodies for trial in body.trials)
        return Bodies(frozenset(), every, is_open=True)
    others = (trial for body in bodies if body is not chosen for trial in body.trials)
    return Bodies(frozenset(chosen.trials), frozenset(others), is_open=False)


def _sort(trials: dict[str, list[Bones]], rules: QualityRules | None) -> list[_Body]:
    bodies: list[_Body] = []
    for trial, bones in trials.items():
        if not bones:
            continue
        known = (body for body in bodies if not is_stranger(bones, body.bones, rules=rules))
        body = next(known, None)
        if body is None:
            bodies.append(body := _Body())
        body.trials.append(trial)
        body.bones += bones
    return bodies


def _find_seen(bodies: list[_Body], lived: Bones, rules: QualityRules | None) -> _Body | None:
    """Tell which body was seen live: the one that is most like it, if that is like it at all.

    It was seen for at least as long as some clips take, so it counts as measured so often.
    """
    nearest = min(bodies, key=lambda body: _tell_distance(body, lived))
    often = [lived] * len(nearest.bones)
    return None if is_stranger(often, nearest.bones, rules=rules) else nearest


def _tell_distance(body: _Body, lived: Bones) -> float:
    return float(np.abs(np.median(np.stack(body.bones), axis=0) - lived).mean())
