"""Phase 2 of the paper: fit one person's decoder, and nothing else, to that person's clips.

Encoder, latent and discriminators are frozen, so everything that they say of a window is computed
once, before training, for a few augmented copies of every window; what is left is the small
decoder alone. Rates may differ by part (discriminative fine-tuning, Howard and Ruder 2018).
"""

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from time import monotonic

import torch
from jaxtyping import Float
from torch import Tensor, nn

from models.correction import MOST_WINDOWS, STRENGTH, WIDTH, Correction
from models.data.augment import Augmentation, augment
from models.data.clips import Clip
from models.data.windows import cut_windows
from models.decoder import Decoder
from models.familiarity import Familiarity, thin_out
from models.losses import reconstruction_loss
from models.predictor import Predictor
from models.training.config import one_cycle

_ENCODE_BATCH = 512


@dataclass(frozen=True, slots=True)
class FinetuneConfig:
    """Everything that decides what phase 2 gives; equal settings and clips give equal weights.

    Attributes:
        steps: optimisation steps.
        batch: windows in a step.
        learning_rate: peak of the one-cycle schedule, well below that of phase 1.
        warm_up: share of the steps in which the rate rises.
        rates: factor on the rate for parts of the decoder, by the beginning of their names.
        copies: augmented copies of every window, as far as `most` allows.
        most: windows, copies included, that are encoded and held; of more than that, every second
            or third is taken, evenly.
        augmentation: what makes the copies; the person's own body and habits, so no mirror.
        average: decay of the moving average of the weights, which is what is kept.
        clip: largest norm of the gradient.
        seed: of sampling and augmentation.
    """

    steps: int = 200
    batch: int = 64
    learning_rate: float = 3e-3
    warm_up: float = 0.15
    rates: Mapping[str, float] = field(default_factory=dict)
    copies: int = 6
    most: int = 30_000
    augmentation: Augmentation = field(
        default_factory=lambda: replace(
            Augmentation(),
            mirror=0.0,
            scale=0.03,
            bones=0.02,
            mix=0.3,
            flicker=0.0,
            tempo=0.0,
            slow=0.0,
            still=0.0,
            posture=0.0,
            movement=0.0,
            travel=0.0,
        )
    )
    average: float = 0.98
    clip: float = 1.0
    seed: int = 0


@dataclass(frozen=True, slots=True)
class FinetuneProgress:
    """Where a fit is; `loss` is that of phase 1, `seconds` have gone by since its first step."""

    step: int
    steps: int
    loss: float
    seconds: float


@dataclass(frozen=True, slots=True)
class Encodings:
    """What the frozen part says of windows, and what the decoder should answer.

    Attributes:
        z: continuous latent.
        c: categorical latent.
        seed: last observed pose, in normalised units.
        target: displacement of every future frame from it, in metres, in canonical heading.
    """

    z: Float[Tensor, "window continuous"]
    c: Float[Tensor, "window category"]
    seed: Float[Tensor, "window joint 3"]
    target: Float[Tensor, "window horizon joint 3"]

    def __len__(self) -> int:
        """Count the windows."""
        return len(self.z)

    def pick(self, chosen: Tensor) -> "Encodings":
        """Give some of the windows, by index or mask."""
        return Encodings(self.z[chosen], self.c[chosen], self.seed[chosen], self.target[chosen])

    def split(self, most: int) -> "list[Encodings]":
        """Give the windows in parts of at most so many."""
        parts = (part.split(most) for part in (self.z, self.c, self.seed, self.target))
        return [Encodings(*part) for part in zip(*parts, strict=True)]


@torch.no_grad()
def encode_windows(
    predictor: Predictor, windows: Float[Tensor, "window time joint 3"]
) -> Encodings:
    """Run the frozen part once over whole windows (observed and future frames, metres)."""
    observe = predictor.spec.observe
    parts = []
    for part in windows.split(_ENCODE_BATCH):
        encoded = predictor.encode(part[:, :observe])
        placed = predictor.normalizer.to_net(part[:, observe:], encoded.placement)
        target = (placed - encoded.seed[:, None]) * predictor.normalizer.scales[0]
        parts.append(Encodings(encoded.z, encoded.c, encoded.seed, target))
    return join_encodings(parts)


def learn_nearby(
    predictor: Predictor,
    clips: Sequence[Clip],
    *,
    width: float = WIDTH,
    strength: float = STRENGTH,
) -> tuple[Familiarity, Correction]:
    """Learn what a person's windows look like, and what the base misses near them.

    Args:
        predictor: the base.
        clips: of one person; their windows are taken as they were recorded, and of a long recording
            only as many are forecast as the equations take.
        width: of the bumps, in the distance of familiarity.
        strength: of the regularisation towards the base.

    Raises:
        ValueError: no clip is as long as a window.
    """
    found = encode_windows(predictor, _cut(clips, predictor))
    familiarity = Familiarity.fit(found.z)
    some = found.pick(thin_out(len(found), MOST_WINDOWS))
    missed = _find_missed(predictor, some)
    return familiarity, Correction.fit(familiarity, some.z, missed, width=width, strength=strength)


@torch.no_grad()
def _find_missed(predictor: Predictor, encodings: Encodings) -> Float[Tensor, "window coordinate"]:
    """Say what the base misses on some windows: displacements in normalised units."""
    horizon, scale = predictor.spec.horizon, predictor.normalizer.scales[0]
    parts = encodings.split(_ENCODE_BATCH)
    made = [predictor.decoder(part.z, part.c, part.seed, horizon=horizon) for part in parts]
    return (encodings.target / scale - torch.cat(made)).flatten(1)


def encode_clips(predictor: Predictor, clips: Sequence[Clip], config: FinetuneConfig) -> Encodings:
    """Cut clips into windows and encode some augmented versions of each.

    Raises:
        ValueError: no clip is as long as a window.
    """
    whole = _cut(clips, predictor)
    whole = whole[:: math.ceil(len(whole) / config.most)]
    copies = min(config.copies, max(1, config.most // len(whole)))
    return join_encodings(
        [
            encode_windows(
                predictor, augment(whole, config.augmentation, observe=predictor.spec.observe)
            )
            for _ in range(copies)
        ]
    )


def join_encodings(parts: Sequence[Encodings]) -> Encodings:
    """Put encodings one after the other."""
    columns = ([part.z, part.c, part.seed, part.target] for part in parts)
    return Encodings(*(torch.cat(column) for column in zip(*columns, strict=True)))


def finetune(
    predictor: Predictor,
    clips: Sequence[Clip],
    config: FinetuneConfig,
    *,
    report: Callable[[FinetuneProgress], None] = lambda _: None,
) -> Decoder:
    """Fit a copy of the decoder to one person's clips; the predictor stays as it is.

    `report` is called after every step and may raise to stop the fit. Deterministic: the same
    predictor, clips, settings and number of threads give the same weights.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        encodings = encode_clips(predictor, clips, config)
        return fit_decoder(predictor, encodings, config, report=report)


def fit_decoder(
    predictor: Predictor,
    encodings: Encodings,
    config: FinetuneConfig,
    *,
    report: Callable[[FinetuneProgress], None] = lambda _: None,
) -> Decoder:
    """Fit a copy of the decoder to windows that were encoded before."""
    scale, horizon = predictor.normalizer.scales[0], predictor.spec.horizon
    base = predictor.decoder
    decoder = copy.deepcopy(base).train().requires_grad_(requires_grad=True)
    average = copy.deepcopy(base)
    optimizer = torch.optim.Adam(_groups(decoder, config))
    began = monotonic()
    for step in range(config.steps):
        part = encodings.pick(torch.randint(len(encodings), (config.batch,)))
        shape = one_cycle(step / config.steps, warm_up=config.warm_up)
        for group in optimizer.param_groups:
            group["lr"] = group["peak"] * shape
        forecast = decoder(part.z, part.c, part.seed, horizon=horizon) * scale
        loss = reconstruction_loss(forecast, part.target)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(decoder.parameters(), config.clip)
        optimizer.step()
        _follow(decoder, average, keep=config.average)
        spent = monotonic() - began
        report(FinetuneProgress(step + 1, config.steps, float(loss.detach()), spent))
    return average.eval().requires_grad_(requires_grad=False)


@torch.no_grad()
def blend(base: Decoder, fitted: Decoder, share: float) -> Decoder:
    """Weights between the base's (0) and the fitted ones (1) (WiSE-FT, Wortsman et al. 2022)."""
    mixed = copy.deepcopy(base)
    parts = zip(mixed.parameters(), fitted.parameters(), strict=True)
    for weight, target in parts:
        weight.lerp_(target, share)
    return mixed


def _cut(clips: Sequence[Clip], predictor: Predictor) -> Float[Tensor, "window time joint 3"]:
    cut = cut_windows(clips, predictor.spec)
    return torch.cat([torch.as_tensor(cut.observed), torch.as_tensor(cut.future)], dim=1)


def _groups(decoder: Decoder, config: FinetuneConfig) -> list[dict[str, object]]:
    """One group of parameters per rate; the longest name that fits decides."""
    groups: dict[float, list[nn.Parameter]] = {}
    for name, parameter in decoder.named_parameters():
        fitting = [prefix for prefix in config.rates if name.startswith(prefix)]
        factor = config.rates[max(fitting, key=len)] if fitting else 1.0
        groups.setdefault(factor, []).append(parameter)
    return [
        {"params": params, "lr": 0.0, "peak": config.learning_rate * factor}
        for factor, params in groups.items()
    ]


@torch.no_grad()
def _follow(decoder: Decoder, average: Decoder, *, keep: float) -> None:
    """Let the average of the weights follow them."""
    for weight, averaged in zip(decoder.parameters(), average.parameters(), strict=True):
        averaged.lerp_(weight, 1 - keep)
