"""What a candidate is examined on: clips divided into what is learnt and what is left out.

Motion *like* that recorded: whole trials left out where there are several, and something can be
learnt from the rest; another repetition of the same action where there is one; else the later part
of a clip of which the earlier part was learnt, so far apart that they share no frame. Motion
*unlike* it: whole clips left out, with all clips of the same action; where fewer than five actions
are told apart, single clips, which may resemble what is learnt.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from app.personalize.judge import FEWEST_UNLIKE
from models.data.clips import Clip
from models.spec import MotionSpec

MIN_BLOCKS = 5
"""With fewer there is nothing to judge by."""
LONG_CLIP_S, BLOCK_S, DROPPED_FRAMES = 4.0, 2.5, 30
"""Blocks are so long that an earlier and a later part of one hold some windows each."""
GAP_FRAMES = 30
"""From the beginning of the last window that is learnt to that of the first one it is judged by."""
TRIAL_FOLDS = 3
"""At most so many trials, or groups of older trials, are left out in turn."""
_SPEC = MotionSpec()


@dataclass(frozen=True, eq=False)
class Fold:
    """One division.

    Attributes:
        learn: what the trial candidate is fitted on.
        like, unlike: what it is judged by.
        trial: which trials were left out as a whole, empty where none was.
    """

    learn: tuple[Clip, ...]
    like: tuple[Clip, ...] = ()
    unlike: tuple[Clip, ...] = ()
    trial: str = ""


def cut_blocks(clips: Sequence[Clip]) -> list[Clip]:
    """Cut long clips into blocks that are independent of each other."""
    blocks: list[Clip] = []
    for clip in clips:
        length = round(BLOCK_S * clip.rate_hz)
        if len(clip.poses) <= LONG_CLIP_S * clip.rate_hz:
            blocks.append(clip)
            continue
        starts = range(0, len(clip.poses) - length + 1, length + DROPPED_FRAMES)
        blocks += [replace(clip, poses=clip.poses[start : start + length]) for start in starts]
    return [block for block in blocks if len(block.poses) >= _SPEC.frames]


def make_folds(blocks: Sequence[Clip]) -> list[Fold]:
    """Divide blocks in the few ways that both questions need; none where there are too few."""
    if len(blocks) < MIN_BLOCKS:
        return []
    trials = list(dict.fromkeys(block.trial for block in blocks))
    whole = _leave_trials_out(blocks, trials)
    if sum(len(fold.like) for fold in whole) < MIN_BLOCKS:
        groups = _group(blocks)
        return [_divide(groups, turn) for turn in (0, 2)]
    return [*whole, _leave_motions_out(blocks, trials[-1])]


def _leave_trials_out(blocks: Sequence[Clip], trials: list[str]) -> list[Fold]:
    """Leave out the newest trial, and the older ones in groups.

    Not where next to nothing stays to be learnt from: a good trial after a short take of two
    seconds would seem to teach nothing.
    """
    older, count = trials[:-1], TRIAL_FOLDS - 1
    groups = [[trials[-1]], *(older[i::count] for i in range(count))]
    folds = []
    for group in filter(None, groups):
        learn = tuple(block for block in blocks if block.trial not in group)
        left = tuple(block for block in blocks if block.trial in group)
        if len(learn) < min(MIN_BLOCKS, len(left)):
            continue
        folds.append(Fold(learn, like=left, trial=", ".join(group)))
    return folds


def _leave_motions_out(blocks: Sequence[Clip], newest: str) -> Fold:
    """Leave out a quarter of the motions: of all trials if labelled, else of the newest.

    Where that would be too few to say anything, of all trials as well; and never fewer than two.
    """
    fresh = [block for block in blocks if block.trial == newest]
    is_labelled = all(block.action for block in blocks)
    groups = _group(blocks if is_labelled or len(fresh) < 4 * FEWEST_UNLIKE else fresh)
    every = 4 if len(groups) >= 4 * FEWEST_UNLIKE else 2
    unlike = tuple(
        block for i, group in enumerate(groups) if i % every == every - 1 for block in group
    )
    left = {id(block) for block in unlike}
    learn = tuple(block for group in groups for block in group if id(block) not in left)
    return Fold(learn, unlike=unlike)


def _group(blocks: Sequence[Clip]) -> list[list[Clip]]:
    """Put the blocks of one action together; each by itself where few actions are labelled."""
    groups: dict[str, list[Clip]] = {}
    for i, block in enumerate(blocks):
        groups.setdefault(block.action or f"clip {i}", []).append(block)
    return list(groups.values()) if len(groups) >= MIN_BLOCKS else [[block] for block in blocks]


def _divide(groups: Sequence[Sequence[Clip]], turn: int) -> Fold:
    """Leave a quarter of the motions out, and of another quarter the later part."""
    learn: list[Clip] = []
    like: list[Clip] = []
    unlike: list[Clip] = []
    for i, group in enumerate(groups):
        role = (i + turn) % 4
        if role == 3:
            unlike += group
        elif role == 0:
            earlier, later = _split(group)
            learn += earlier
            like += later
        else:
            learn += group
    return Fold(tuple(learn), tuple(like), tuple(unlike))


def _split(group: Sequence[Clip]) -> tuple[list[Clip], list[Clip]]:
    """Split a motion into what is learnt and what it is judged by."""
    if len(group) > 1:
        return list(group[:-1]), [group[-1]]
    clip = group[0]
    starts = len(clip.poses) - _SPEC.frames + 1
    early = (starts - GAP_FRAMES + 1) // 2
    if starts - GAP_FRAMES < 2:  # one window says too little
        return [clip], []
    earlier = replace(clip, poses=clip.poses[: early + _SPEC.frames - 1])
    return [earlier], [replace(clip, poses=clip.poses[early - 1 + GAP_FRAMES :])]
