"""Train the peer and fine-tune it for a person, on the same data and by the same rules as ours.

Same clips and shares of a batch as the base, the same kind of schedule and averaged weights, and
every choice made on left-out subjects. The objective is the peer's own; the augmentation is of the
same kinds, but milder than the base's, which so small a net cannot carry (see LOG.md).
"""

import copy
from collections.abc import Callable, Collection, Sequence
from dataclasses import asdict, dataclass, field, replace
from time import monotonic
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from models.arithmetic import arithmetic
from models.baselines.simlpe import Simlpe, SimlpeSizes
from models.data.augment import Augmentation, augment
from models.data.clips import Clip, data_hash
from models.data.splits import split_by_person
from models.data.windows import Windows, cut_windows
from models.losses import distance_loss
from models.metrics import Scores
from models.training.config import PretrainConfig, one_cycle
from models.training.evaluate import score_forecaster
from models.training.loop import Progress, draw_augmented
from models.training.pretrain import current_commit, describe_clips
from models.training.sampler import WindowSampler

_OURS = PretrainConfig()
_FITTING_DRAWS = 8
_CALM = Augmentation(
    tilt_rad=0.0, bones=0.0, offset_m=0.0, noise_m=0.0, still=0.0, tempo=0.0, slow=0.0,
    flicker=0.0, mix=0.0, posture=0.0, movement=0.0, travel=0.0,
)  # fmt: skip
MILD = replace(_CALM, mirror=0.5, yaw_rad=0.6, scale=0.1)
"""Sides, heading and size: with it the left-out subject is foreseen better than with the base's."""
OWN_BODY = replace(_CALM, mirror=0.0, yaw_rad=0.1, scale=0.03)
"""What is left of it for one person."""


@dataclass(frozen=True, slots=True)
class SimlpeConfig:
    """Everything that decides what training gives; equal settings and data give equal weights.

    Taken over from the base's settings: shares and pools of the sampler, warm-up, averaging of the
    weights, largest gradient. Tried on a left-out subject, see LOG.md: heading, blends, objective,
    steps.

    Attributes:
        sizes: of the net.
        augmentation: see `Augmentation`.
        steps: optimisation steps.
        batch: windows in a step.
        learning_rate: peak of the one-cycle schedule.
        warm_up: share of the steps in which the rate rises.
        weight_decay: AdamW's.
        clip: largest norm of the gradient.
        average: decay of the moving average of the weights, which is what is kept.
        shares, pools: see `PretrainConfig`.
        seed: of the initial weights, the sampling and the augmentation.
        evaluate_every: steps between validations on the people left out.
    """

    sizes: SimlpeSizes = field(default_factory=SimlpeSizes)
    augmentation: Augmentation = MILD
    steps: int = 5_000
    batch: int = 128
    learning_rate: float = 3e-3
    warm_up: float = _OURS.warm_up
    weight_decay: float = 1e-4
    clip: float = _OURS.clip
    average: float = _OURS.average
    shares: dict[str, float] = field(default_factory=lambda: dict(_OURS.shares))
    pools: tuple[tuple[str, ...], ...] = _OURS.pools
    seed: int = 0
    evaluate_every: int = 500


@dataclass(frozen=True, slots=True)
class SimlpeFinetune:
    """How all of the net is fitted to one person's clips; chosen on left-out subjects.

    Attributes:
        steps: optimisation steps.
        batch: windows in a step.
        learning_rate: peak of the one-cycle schedule.
        warm_up: share of the steps in which the rate rises.
        weight_decay: AdamW's.
        clip: largest norm of the gradient.
        average: decay of the moving average of the weights, which is what is kept.
        augmentation: see `Augmentation`.
        seed: of sampling and augmentation.
    """

    steps: int = 600
    batch: int = 64
    learning_rate: float = 3e-3
    warm_up: float = 0.15
    weight_decay: float = 1e-4
    clip: float = 1.0
    average: float = 0.98
    augmentation: Augmentation = OWN_BODY
    seed: int = 0


@dataclass(frozen=True, slots=True)
class TrainedSimlpe:
    """A trained peer and what is known of it; `scores` are on the people left out, if any."""

    net: Simlpe
    metadata: dict[str, Any]
    scores: Scores | None


def train_simlpe(
    clips: Sequence[Clip],
    config: SimlpeConfig,
    *,
    leave_out: Collection[tuple[str, str]] = (),
    report: Callable[[Progress], None] = lambda _: None,
) -> TrainedSimlpe:
    """Train a peer.

    Args:
        clips: everybody, those to leave out included.
        config: see `SimlpeConfig`.
        leave_out: people (source, subject) who are validated on and never trained on.
        report: called after every step; its validation is in cm², cumulative at the last frame.

    Raises:
        ValueError: a person to leave out has no clip, or no clip is as long as a window.
    """
    split = split_by_person(clips, leave_out)
    began = monotonic()
    with arithmetic(1), torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        net = Simlpe(sizes=config.sizes)
        windows = cut_windows(split.held_out, net.spec) if split.held_out else None
        net = _descend(net, _make_sampler(split.train, config), config, windows, report)
    scores = score_forecaster(net, windows) if windows else None
    metadata = {
        "training": asdict(config),
        "seconds": round(monotonic() - began, 1),
        "data": describe_clips(split.train),
        "data_sha256": data_hash(split.train),
        "left_out": sorted("/".join(person) for person in leave_out),
        "validation": asdict(scores) if scores else None,
        "commit": current_commit(),
        "torch": torch.__version__,
    }
    return TrainedSimlpe(net, metadata, scores)


def personalize_simlpe(net: Simlpe, clips: Sequence[Clip], config: SimlpeFinetune) -> Simlpe:
    """Fine-tune a copy of the whole net on one person's clips; deterministic by the seed.

    Raises:
        ValueError: no clip is as long as a window.
    """
    cut = cut_windows(clips, net.spec)
    whole = torch.cat([torch.as_tensor(cut.observed), torch.as_tensor(cut.future)], dim=1)
    observe = net.spec.observe
    with arithmetic(1), torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        run = _Run(net, weight_decay=config.weight_decay, clip=config.clip, keep=config.average)
        for step in range(config.steps):
            chosen = whole[torch.randint(len(whole), (config.batch,))]
            rate = config.learning_rate * one_cycle(step / config.steps, warm_up=config.warm_up)
            run.step(augment(chosen, config.augmentation, observe=observe), rate)
    return run.finish()


class _Run:
    """Descends the peer's objective and follows the weights by their average."""

    def __init__(self, net: Simlpe, *, weight_decay: float, clip: float, keep: float) -> None:
        self.net = copy.deepcopy(net).train().requires_grad_(requires_grad=True)
        self.average = copy.deepcopy(net).eval().requires_grad_(requires_grad=False)
        self.optimizer = torch.optim.AdamW(
            self.net.parameters(), weight_decay=weight_decay, fused=True
        )
        self.clip, self.keep, self.steps = clip, keep, 0

    def step(self, windows: Float[Tensor, "batch time joint 3"], rate: float) -> float:
        """Take one step at a learning rate; give the loss in metres."""
        observe = self.net.spec.observe
        loss = distance_loss(self.net(windows[:, :observe]), windows[:, observe:])
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(self.net.parameters(), self.clip)
        self.optimizer.step()
        keep = min(self.keep, (1 + self.steps) / (10 + self.steps))
        with torch.no_grad():
            weights = [weight.detach() for weight in self.net.parameters()]
            torch._foreach_lerp_(list(self.average.parameters()), weights, 1 - keep)
        self.steps += 1
        return float(loss.detach())

    def finish(self) -> Simlpe:
        """Give the averaged net."""
        return self.average


def _descend(
    net: Simlpe,
    sampler: WindowSampler,
    config: SimlpeConfig,
    windows: Windows | None,
    report: Callable[[Progress], None],
) -> Simlpe:
    observe = net.spec.observe
    fitting = [
        draw_augmented(sampler, config.augmentation, observe=sampler.length).windows
        for _ in range(_FITTING_DRAWS)
    ]
    net.normalizer.fit(torch.cat(fitting)[:, :observe])
    run = _Run(net, weight_decay=config.weight_decay, clip=config.clip, keep=config.average)
    began = monotonic()
    for step in range(1, config.steps + 1):
        drawn = draw_augmented(sampler, config.augmentation, observe=observe)
        rate = config.learning_rate * one_cycle((step - 1) / config.steps, warm_up=config.warm_up)
        loss = run.step(drawn.windows, rate)
        due = windows is not None and step % config.evaluate_every == 0
        score = score_forecaster(run.average, windows).mse_cm2[-1] if due and windows else None
        left = (monotonic() - began) / step * (config.steps - step)
        report(Progress(step, config.steps, loss, 0.0, score, left))
    return run.finish()


def _make_sampler(clips: Sequence[Clip], config: SimlpeConfig) -> WindowSampler:
    return WindowSampler(
        clips,
        length=Simlpe().spec.frames,
        batch=config.batch,
        shares=config.shares,
        pools=config.pools,
        tempo=config.augmentation.tempo,
        slow=config.augmentation.slow,
        device=torch.device("cpu"),
    )
