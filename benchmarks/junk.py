"""Recordings that nothing good can be learnt from."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from models.data.clips import Clip
from models.skeleton import KINECT_V1


def add_noise(clips: Sequence[Clip]) -> list[Clip]:
    """Shake every joint by a decimetre in every frame."""
    draw = np.random.default_rng(0)
    return [
        replace(
            clip, poses=clip.poses + 0.1 * draw.standard_normal(clip.poses.shape, dtype=np.float32)
        )
        for clip in clips
    ]


def freeze(clips: Sequence[Clip]) -> list[Clip]:
    """Repeat the first pose."""
    return [replace(clip, poses=np.repeat(clip.poses[:1], len(clip.poses), 0)) for clip in clips]


def swap_sides(clips: Sequence[Clip]) -> list[Clip]:
    """Exchange left and right joints."""
    return [replace(clip, poses=clip.poses[:, list(KINECT_V1.mirror)]) for clip in clips]


def shorten(clips: Sequence[Clip]) -> list[Clip]:
    """Keep 29 frames of every clip, one less than a window has."""
    return [replace(clip, poses=clip.poses[:29]) for clip in clips]


def shuffle(clips: Sequence[Clip]) -> list[Clip]:
    """Put the frames of every clip in any order."""
    draw = np.random.default_rng(0)
    return [replace(clip, poses=draw.permutation(clip.poses)) for clip in clips]


JUNK: dict[str, Callable[[Sequence[Clip]], list[Clip]]] = {
    "noise": add_noise,
    "frozen": freeze,
    "swapped sides": swap_sides,
    "29 frames": shorten,
    "shuffled frames": shuffle,
}
