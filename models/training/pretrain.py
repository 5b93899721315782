"""Phase 1 of the paper as a function: clips in, a checkpoint out."""

import subprocess
from collections.abc import Callable, Collection, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np
import torch

from models.checkpoint import save_checkpoint
from models.data.clips import Clip, data_hash
from models.data.splits import split_by_person
from models.data.windows import Windows, cut_windows
from models.latent import Adversary
from models.metrics import FRAMES, Scores, evaluate_forecasts
from models.predictor import Predictor, forecast_in_batches
from models.rounding import round_matrices
from models.spec import MotionSpec
from models.training.config import PretrainConfig
from models.training.loop import Progress, Trainer, train
from models.training.sampler import WindowSampler, list_actions

_VALIDATION_WINDOWS = 4_000


@dataclass(frozen=True, slots=True)
class Pretrained:
    """A trained net and what is known of it; `scores` are on the people left out, if any."""

    predictor: Predictor
    adversary: Adversary | None
    metadata: dict[str, Any]
    scores: Scores | None


def pretrain(
    clips: Sequence[Clip],
    config: PretrainConfig,
    *,
    leave_out: Collection[tuple[str, str]] = (),
    report: Callable[[Progress], None] = lambda _: None,
    state: Path | None = None,
    device: torch.device | None = None,
    trainer_type: type[Trainer] = Trainer,
) -> Pretrained:
    """Train a base model.

    Args:
        clips: everybody, those to leave out included.
        config: see `PretrainConfig`.
        leave_out: people (source, subject) who are validated on and never trained on.
        report: called after every step.
        state: where to keep the state of the run; a run whose state is there is resumed.
        device: CUDA if there is any, else the CPU, unless told.
        trainer_type: a trainer of another net or objective, for comparisons.

    Returns:
        The net of averaged weights, on the CPU, with metadata for its checkpoint.
    """
    device = device or choose_device()
    split = split_by_person(clips, leave_out)
    spec = MotionSpec()
    with torch.random.fork_rng():
        sampler = WindowSampler(
            split.train,
            length=spec.frames,
            batch=config.batch,
            shares=config.shares,
            pools=config.pools,
            tempo=config.augmentation.tempo,
            slow=config.augmentation.slow,
            device=device,
            labels=list_actions(split.train, config.label_source),
            moments=config.moments,
        )
        trainer = trainer_type(config, sampler, device=device)
        windows = _validation_windows(split.held_out, spec)
        began = monotonic()
        net = train(
            trainer,
            validate=lambda net: _last_error(score(net, windows)) if windows else None,
            report=report,
            state=state,
        ).cpu()
    round_matrices(
        net
    )  # before anybody scores it: the net that is stored is the one that is served
    scores = score(net, windows) if windows else None
    metadata = {
        "pretraining": asdict(config),
        "steps_run": trainer.step,
        "seconds": round(monotonic() - began, 1),
        "data": describe_clips(split.train),
        "data_sha256": data_hash(split.train),
        "left_out": sorted("/".join(person) for person in leave_out),
        "validation": asdict(scores) if scores else None,
        "commit": current_commit(),
        "torch": torch.__version__,
    }
    adversary = trainer.adversary.cpu().eval() if config.adversarial_weight > 0 else None
    return Pretrained(net, adversary, metadata, scores)


def choose_device() -> torch.device:
    """CUDA where there is a device, else the CPU."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def score(net: Predictor, windows: Windows) -> Scores:
    """Score a net by the pinned protocol, wherever its weights are."""
    device = next(net.parameters()).device
    forecast = forecast_in_batches(net, torch.as_tensor(windows.observed).to(device))
    return evaluate_forecasts(forecast.cpu().numpy(), windows.future)


def describe_clips(clips: Sequence[Clip]) -> dict[str, dict[str, Any]]:
    """Who is in the data: subjects, clips and frames of each source."""
    described: dict[str, dict[str, Any]] = {}
    for source in sorted({clip.source for clip in clips}):
        own = [clip for clip in clips if clip.source == source]
        described[source] = {
            "subjects": sorted({clip.subject for clip in own}, key=lambda s: (len(s), s)),
            "clips": len(own),
            "frames": sum(len(clip.poses) for clip in own),
        }
    return described


def current_commit() -> str | None:
    """Name the commit of the code, where it runs from a git checkout."""
    try:
        found = subprocess.run(  # fixed words, nothing of a user's
            ["git", "describe", "--always", "--dirty", "--abbrev=12"],  # noqa: S607
            cwd=Path(__file__).parent,
            capture_output=True,
            text=True,
            check=True,
            timeout=5,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return found.stdout.strip() or None


def write_pretrained(path: Path, pretrained: Pretrained, *, command: str) -> str:
    """Save the checkpoint; give its sha256."""
    metadata = pretrained.metadata | {"command": command}
    net, adversary = pretrained.predictor, pretrained.adversary
    return save_checkpoint(path, net, metadata, adversary=adversary)


def _validation_windows(clips: Sequence[Clip], spec: MotionSpec) -> Windows | None:
    if not clips:
        return None
    windows = cut_windows(clips, spec)
    keep = np.arange(0, len(windows), max(1, len(windows) // _VALIDATION_WINDOWS))
    return Windows(
        observed=windows.observed[keep],
        future=windows.future[keep],
        clip=windows.clip[keep],
        start=windows.start[keep],
    )


def _last_error(scores: Scores) -> float:
    return scores.mse_cm2[FRAMES.index(max(FRAMES))]
