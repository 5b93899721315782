"""Whether what was trained may answer: plain numbers in, a verdict and its reason out.

The clip is the unit, never the window: windows of a clip overlap and say the same twice.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from app.domain.versions import Verdict
from models.data.clips import Clip
from models.metrics import FRAMES
from models.spec import MotionSpec

MIN_BLOCKS = 5
LONG_CLIP_S, BLOCK_S, DROPPED_FRAMES = 4.0, 2.0, 30
EVERY_NTH = 4


@dataclass(frozen=True, eq=False)
class Figures:
    """Errors on what was left out, for each clip and reported frame, in cm².

    Attributes:
        before: of the base.
        after: of the candidate.
    """

    before: Float[np.ndarray, "clip frame"]
    after: Float[np.ndarray, "clip frame"]

    def summarise(self) -> dict[str, Any]:
        """Write the figures as they are stored with a version."""
        better = self.after[:, -1] < self.before[:, -1]
        return {
            "frames": list(FRAMES),
            "before": np.round(self.before.mean(axis=0), 3).tolist(),
            "after": np.round(self.after.mean(axis=0), 3).tolist(),
            "clips_won": int(better.sum()),
            "clips_lost": int((~better).sum()),
        }


def judge(figures: Figures) -> tuple[Verdict, str]:
    """Promote what is better than the base by more than one standard error over clips."""
    gain = 1 - figures.after[:, -1] / np.maximum(figures.before[:, -1], 1e-9)
    sure = float(gain.mean() - gain.std(ddof=1) / np.sqrt(len(gain)))
    told = f"On {len(gain)} clips left out the error changes by {-gain.mean():+.1%}"
    if sure > 0:
        return Verdict.PROMOTE, f"{told}: better than before."
    return Verdict.REJECT, f"{told}: not surely better than before."


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
    return [block for block in blocks if len(block.poses) >= MotionSpec().frames]


def leave_out(blocks: Sequence[Clip]) -> tuple[list[Clip], list[Clip]]:
    """Split into what to learn from and what to judge by; nothing to judge by where too few."""
    if len(blocks) < MIN_BLOCKS:
        return list(blocks), []
    held_out = [block for i, block in enumerate(blocks) if i % EVERY_NTH == EVERY_NTH - 1]
    held_out = held_out if len(held_out) > 1 else list(blocks[-2:])
    left = {id(block) for block in held_out}
    return [block for block in blocks if id(block) not in left], held_out
