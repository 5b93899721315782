"""Measuring a candidate on what it was not fitted on, exactly as it would be served."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from app.personalize.folds import Fold
from app.personalize.judge import REACHES, Figures, Rival, join, no_figures
from models.data.clips import Clip
from models.data.windows import Windows, cut_windows
from models.metrics import FRAMES
from models.personal import PersonalDecoder
from models.training.finetune import Encodings, encode_windows

_BATCH = 512
_CM2_PER_M2 = 1e4


@dataclass(frozen=True, eq=False)
class Examined:
    """What came out of one fold.

    Attributes:
        like, unlike: the errors.
        offsets: distances between forecast and truth of all windows left out, in metres, for
            every one of `REACHES`.
    """

    like: Figures
    unlike: Figures
    offsets: Float[np.ndarray, "reach window horizon joint"]

    @property
    def both(self) -> Figures:
        """The errors on all that was left out."""
        return join([self.like, self.unlike])

    def distances(self, reach: float) -> Float[np.ndarray, "window horizon joint"]:
        """Give the distances at one reach of the gate."""
        return np.asarray(self.offsets[REACHES.index(reach)])


def examine(candidate: PersonalDecoder, fold: Fold) -> Examined:
    """Measure a candidate at every reach on what its fold left out."""
    like, like_off = _measure(candidate, fold.like)
    unlike, unlike_off = _measure(candidate, fold.unlike)
    return Examined(like, unlike, np.concatenate([like_off, unlike_off], axis=1))


def measure_rival(active: PersonalDecoder, clips: Sequence[Clip], candidate: Figures) -> Rival:
    """Measure the active version, on its own encoder, on clips that a candidate was measured on."""
    windows = cut_windows(clips, active.base.spec)
    truth = torch.from_numpy(windows.future)
    with torch.inference_mode():
        parts = torch.from_numpy(windows.observed).split(_BATCH)
        forecast = torch.cat([active(part) for part in parts])
        errors = _average(_cumulate(forecast - truth), windows)
    return Rival(
        base=candidate.before[:, -1], active=errors[:, -1], candidate=candidate.after[:, :, -1]
    )


def _measure(
    candidate: PersonalDecoder, clips: Sequence[Clip]
) -> tuple[Figures, Float[np.ndarray, "reach window horizon joint"]]:
    spec = candidate.base.spec
    if not clips:
        return no_figures(), np.zeros((len(REACHES), 0, spec.horizon, spec.joints), np.float32)
    windows = cut_windows(clips, spec)
    whole = torch.from_numpy(np.concatenate([windows.observed, windows.future], axis=1))
    with torch.inference_mode():
        found = encode_windows(candidate.base, whole)
        of_base, of_person = _roll(candidate, found)
        errors, offsets = [], []
        for reach in REACHES:
            gate = torch.cat([candidate.reaching(reach).share(z) for z in found.z.split(_BATCH)])
            off = torch.lerp(of_base, of_person, gate[:, None, None, None]) - found.target
            errors.append(_average(_cumulate(off), windows))
            offsets.append(off.norm(dim=-1).numpy())
        before = _average(_cumulate(of_base - found.target), windows)
    return Figures(before, np.stack(errors)), np.stack(offsets)


def _roll(candidate: PersonalDecoder, encodings: Encodings) -> tuple[Tensor, Tensor]:
    """Forecast by the base and by the person alone: displacements in metres, canonical heading."""
    base, of_base, of_person = candidate.base, [], []
    for part in encodings.split(_BATCH):
        given = (part.z, part.c, part.seed)
        moved = base.decoder(*given, horizon=base.spec.horizon)
        own = candidate.decoder(*given, horizon=base.spec.horizon)
        of_base.append(moved)
        of_person.append(candidate.correct(own, moved, part.z))
    scale = base.normalizer.scales[0]
    return torch.cat(of_base) * scale, torch.cat(of_person) * scale


def _cumulate(off: Float[Tensor, "window horizon joint 3"]) -> Float[np.ndarray, "window frame"]:
    """Give the cumulative squared error at the reported frames, cm²."""
    errors = off.double().square().mean(dim=(2, 3)).cumsum(dim=1) * _CM2_PER_M2
    return np.stack([errors[:, frame - 1].numpy() / frame for frame in FRAMES], axis=1)


def _average(
    errors: Float[np.ndarray, "window frame"], windows: Windows
) -> Float[np.ndarray, "clip frame"]:
    """Average the windows of each clip."""
    clips, place, counts = np.unique(windows.clip, return_inverse=True, return_counts=True)
    total = np.zeros((len(clips), errors.shape[1]))
    np.add.at(total, place, errors)
    return total / counts[:, None]
