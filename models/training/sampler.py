"""Draws training windows: by source in fixed shares, uniformly within a source, at varied tempo."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from models.data.clips import Clip

_VARIED = 0.5


@dataclass(frozen=True, slots=True)
class Drawn:
    """The windows of one pool in a batch, and what they show.

    Attributes:
        windows: observed and future frames, metres.
        labels: 1 for the moment that a window shows (its action, and which part of it: those of one
            action stand together), 0 for the others; all 0 where nobody named the action.
    """

    windows: Float[Tensor, "batch time joint 3"]
    labels: Float[Tensor, "batch moment"]


@dataclass(frozen=True, slots=True)
class _Group:
    """All windows of one source.

    Attributes:
        share: windows of it in a batch.
        starts: where each window begins.
        room: frames that its clip has from there.
        moment: place of its moment among all, by the middle of the window at the speed of the
            recording; -1 for none. At a lower speed a window shows what comes before it.
    """

    share: int
    starts: Int[Tensor, " windows"]
    room: Int[Tensor, " windows"]
    moment: Int[Tensor, " windows"]


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
        labels: the actions, as (source, action), that windows are labelled with.
        moments: into how many parts of equal length an action is divided.
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
        labels: Sequence[tuple[str, str]] = (),
        moments: int = 1,
    ) -> None:
        usable = [clip for clip in clips if len(clip.poses) >= length]
        if not usable:
            raise ValueError(f"none of {len(clips)} clips has the {length} frames of a window")
        self.length = length
        self.tempo = tempo
        self.slow = slow
        self.labels = tuple(labels)
        self.moments = moments
        self.frames = torch.cat([torch.as_tensor(clip.poses) for clip in usable]).to(device)
        counts = _windows_by_source(usable, batch=batch, shares=shares)
        self.groups = {
            source: _group(usable, source, count, length, self.labels, moments)
            for source, count in counts.items()
        }
        self.parts = _join(list(self.groups), pools)

    def draw(self) -> list[Drawn]:
        """Draw one batch with torch's global generator, each pool of sources by itself."""
        return [
            _put_together(self._draw(self.groups[source]) for source in part) for part in self.parts
        ]

    def _draw(self, group: _Group) -> Drawn:
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
        count = len(self.labels) * self.moments
        labels = functional.one_hot(group.moment[chosen] + 1, count + 1)[:, 1:]
        return Drawn(first + part * (second - first), labels.float())


def list_actions(clips: Iterable[Clip], source: str) -> list[tuple[str, str]]:
    """Name the actions of a source as labels, in a fixed order: (source, action)."""
    found = {clip.action for clip in clips if clip.source == source and clip.action}
    return [(source, action) for action in sorted(found, key=lambda name: (len(name), name))]


def _put_together(parts: Iterable[Drawn]) -> Drawn:
    windows, labels = zip(*((part.windows, part.labels) for part in parts), strict=True)
    return Drawn(torch.cat(windows), torch.cat(labels))


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


def _group(
    clips: Sequence[Clip],
    source: str,
    share: int,
    length: int,
    labels: Sequence[tuple[str, str]],
    moments: int,
) -> _Group:
    place = {label: index for index, label in enumerate(labels)}
    starts, rooms, shown, offset = [], [], [], 0
    for clip in clips:
        frames = len(clip.poses)
        if clip.source == source:
            first = torch.arange(frames - length + 1)
            starts.append(offset + first)
            rooms.append(frames - first)
            action = place.get((source, clip.action), -1)
            part = (first + length // 2) * moments // frames
            shown.append(action * moments + part if action >= 0 else torch.full_like(first, -1))
        offset += frames
    return _Group(share, torch.cat(starts), torch.cat(rooms), torch.cat(shown))
