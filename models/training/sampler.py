"""Draws training windows: by source in fixed shares, uniformly within a source, at varied tempo."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from models.data.clips import Clip

_VARIED = 0.5


@dataclass(frozen=True, slots=True)
class _Group:
    """All windows of one source: where each begins, and how many frames its clip has from there."""

    share: int
    starts: Int[Tensor, " windows"]
    room: Int[Tensor, " windows"]


class WindowSampler:
    """Batches of whole windows (observed and future frames) from clips of several sources.

    Args:
        clips: the recordings; those shorter than a window are left out.
        length: frames in a window.
        batch: windows in a batch.
        shares: part of a batch by source; sources not named share the rest equally.
        pools: sources that are drawn into one part of the batch; others are parts by themselves.
        tempo: speed of every other window, uniform within 1 plus or minus this where its clip
            allows; the others keep their frames as the sensor gave them, noise and all.
        slow: probability of a speed anywhere between 0 and 1 instead, so that no pose by itself
            means that motion must follow.
        device: where the frames are kept.

    Raises:
        ValueError: no clip is long enough.
    """

    def __init__(
        self,
        clips: Sequence[Clip],
        *,
        length: int,
        batch: int,
        shares: Mapping[str, float],
        pools: Collection[Collection[str]],
        tempo: float,
        slow: float,
        device: torch.device,
    ) -> None:
        usable = [clip for clip in clips if len(clip.poses) >= length]
        if not usable:
            raise ValueError(f"none of {len(clips)} clips has the {length} frames of a window")
        self.length = length
        self.tempo = tempo
        self.slow = slow
        self.frames = torch.cat([torch.as_tensor(clip.poses) for clip in usable]).to(device)
        counts = _windows_by_source(usable, batch=batch, shares=shares)
        self.groups = {
            source: _group(usable, source, count, length) for source, count in counts.items()
        }
        self.parts = _join(list(self.groups), pools)

    def draw(self) -> list[Float[Tensor, "_ time joint 3"]]:
        """Draw one batch with torch's global generator, each pool of sources by itself."""
        return [
            torch.cat([self._draw(self.groups[source]) for source in part]) for part in self.parts
        ]

    def _draw(self, group: _Group) -> Float[Tensor, "share time joint 3"]:
        device = self.frames.device
        chosen = torch.randint(len(group.starts), (group.share,)).to(device)
        start, room = group.starts[chosen], group.room[chosen]
        tempo = 1 + self.tempo * (2 * torch.rand(group.share, device=device) - 1)
        tempo = torch.where(torch.rand(group.share, device=device) < _VARIED, tempo, 1.0)
        slow = torch.rand(group.share, device=device) < self.slow
        tempo = torch.where(slow, torch.rand(group.share, device=device), tempo)
        tempo = torch.minimum(tempo, (room - 1) / (self.length - 1))
        at = tempo[:, None] * torch.arange(self.length, device=device)
        before = at.floor().long().clamp(max=self.length * 2)
        after = torch.minimum(before + 1, (room - 1)[:, None])
        part = (at - before)[..., None, None]
        first, second = self.frames[start[:, None] + before], self.frames[start[:, None] + after]
        return first + part * (second - first)


def _windows_by_source(
    clips: Sequence[Clip], *, batch: int, shares: Mapping[str, float]
) -> dict[str, int]:
    """Whole windows per source that add up to the batch."""
    sources = sorted({clip.source for clip in clips})
    named = {source: share for source, share in shares.items() if source in sources}
    others = [source for source in sources if source not in named]
    rest = 1 - sum(named.values())
    weights = named | {source: rest / len(others) for source in others}
    total = sum(weights.values())
    counts = {source: round(batch * weights[source] / total) for source in sources}
    largest = max(counts, key=lambda source: counts[source])
    counts[largest] += batch - sum(counts.values())
    return {source: count for source, count in counts.items() if count > 0}


def _join(sources: Sequence[str], pools: Collection[Collection[str]]) -> list[list[str]]:
    """Sort the sources into the pools that name them, the others each into one of its own."""
    joined = [[source for source in sources if source in pool] for pool in pools]
    named = {source for part in joined for source in part}
    alone = [[source] for source in sources if source not in named]
    return [part for part in joined if part] + alone


def _group(clips: Sequence[Clip], source: str, share: int, length: int) -> _Group:
    starts, rooms, offset = [], [], 0
    for clip in clips:
        frames = len(clip.poses)
        if clip.source == source:
            first = torch.arange(frames - length + 1)
            starts.append(offset + first)
            rooms.append(frames - first)
        offset += frames
    return _Group(share, torch.cat(starts), torch.cat(rooms))
