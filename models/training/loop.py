"""One training run as an object: step, evaluate, save, resume.

The whole state (weights, their average, both optimisers, random numbers, step) goes into one
safetensors file, so a run that was killed goes on to the very result of an unbroken one.
"""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from time import monotonic
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from models.checkpoint import parse_state, write_state
from models.data.augment import Augmentation, augment_labelled
from models.latent import Adversary
from models.losses import label_loss, reconstruction_loss
from models.predictor import Predictor
from models.symmetry import Symmetry
from models.training.config import PretrainConfig
from models.training.moments import MomentReader
from models.training.sampler import Drawn, WindowSampler

_GRADIENT_NORM_OF_ADVERSARY = 5.0


@dataclass(frozen=True, slots=True)
class Progress:
    """What a progress bar shows. `validation` is in cm², cumulative at the last frame."""

    step: int
    steps: int
    loss: float
    adversary: float
    validation: float | None
    seconds: float


class Trainer:
    """Phase 1 of the paper: reconstruction and the adversarial game, with averaged weights.

    Raises:
        ValueError: the sampler labels windows with more actions than the net has categories.
    """

    def __init__(
        self, config: PretrainConfig, sampler: WindowSampler, *, device: torch.device
    ) -> None:
        if len(sampler.labels) > config.net.categories:
            raise ValueError(
                f"{len(sampler.labels)} actions do not fit into {config.net.categories} categories"
            )
        torch.manual_seed(config.seed)
        self.config = config
        self.sampler = sampler
        self.device = device
        self.net = self.make_net()
        self.net.normalizer.fit(self._observed(_fitting_windows(sampler, config)))
        self.net.to(device)
        self.symmetry = self.make_symmetry() if config.symmetric else None
        if self.symmetry is not None:
            self.symmetry.impose(self.net, is_fresh=True)
        self.average = self.make_net().to(device)
        self.average.load_state_dict(self.net.state_dict())
        self.adversary = Adversary(
            continuous=config.net.continuous,
            categories=config.net.categories,
            hidden=config.adversary_hidden,
        ).to(device)
        self.reader = self._make_reader()
        trained = [self.net] if self.reader is None else [self.net, self.reader]
        self.optimizer = torch.optim.AdamW(
            [weight for part in trained for weight in part.parameters()],
            lr=config.learning_rate,
            weight_decay=config.weight_decay,
        )
        self.adversary_optimizer = torch.optim.Adam(
            self.adversary.parameters(), lr=config.adversary_rate, betas=(0.5, 0.999)
        )
        self.step = 0
        torch.manual_seed(config.seed + 1)

    def make_net(self) -> Predictor:
        """Make a fresh net."""
        return Predictor(config=self.config.net)

    def make_symmetry(self) -> Symmetry:
        """Tell how mirroring acts on the net."""
        return Symmetry(self.net)

    def _make_reader(self) -> MomentReader | None:
        """Make what teaches z moments, where there are any to teach."""
        count = len(self.sampler.labels) * self.sampler.moments
        if count == 0 or self.config.moment_weight == 0:
            return None
        size, symmetric = self.config.net.continuous, self.config.symmetric
        reader = MomentReader(continuous=size, moments=count, symmetric=symmetric)
        return reader.to(self.device)

    def measure(self, forecast: Tensor, future: Tensor) -> Tensor:
        """Give the loss of a batch of forecasts."""
        return reconstruction_loss(forecast, future)

    def run_step(self) -> tuple[float, float]:
        """Take one optimisation step; give the reconstruction's and the discriminators' loss."""
        self.net.train()
        spec = self.net.spec
        drawn = draw_augmented(self.sampler, self.config.augmentation, observe=spec.observe)
        windows = drawn.windows
        observed, future = windows[:, : spec.observe], windows[:, spec.observe :]
        encoded = self.net.encode(observed)
        loss = self.measure(self.net.decode(encoded, observed), future)
        weight = self.config.adversarial_weight_at(self.step)
        total = loss
        if self.config.label_weight > 0:
            total = total + self.config.label_weight * label_loss(encoded.c, self._actions(drawn))
        if self.reader is not None:
            total = total + self.config.moment_weight * self.reader.loss(encoded.z, drawn.labels)
        if weight > 0:
            total = total + weight * self.adversary.encoder_loss(encoded.z, encoded.c)
        self._descend(total)
        fooled = self._train_adversary(encoded.z, encoded.c) if weight > 0 else 0.0
        self.step += 1
        return float(loss.detach()), fooled

    def _actions(self, drawn: Drawn) -> Float[Tensor, "batch action"]:
        """Tell the actions of a batch, whatever part of them a window shows."""
        shape = (len(drawn.labels), len(self.sampler.labels), self.sampler.moments)
        return drawn.labels.view(shape).sum(2)

    def _descend(self, loss: Float[Tensor, ""]) -> None:
        for group in self.optimizer.param_groups:
            group["lr"] = self.config.rate_at(self.step)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        if self.symmetry is not None:
            self.symmetry.impose_on_gradients(self.net)
        nn.utils.clip_grad_norm_(self.net.parameters(), self.config.clip)
        self.optimizer.step()
        keep = min(self.config.average, (1 + self.step) / (10 + self.step))
        pairs = zip(self.average.parameters(), self.net.parameters(), strict=True)
        with torch.no_grad():
            for averaged, current in pairs:
                averaged.lerp_(current, 1 - keep)

    def _train_adversary(self, z: Tensor, c: Tensor) -> float:
        loss = self.adversary.discriminator_loss(z, c)
        self.adversary_optimizer.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(self.adversary.parameters(), _GRADIENT_NORM_OF_ADVERSARY)
        self.adversary_optimizer.step()
        return float(loss.detach())

    def _observed(self, windows: Tensor) -> Tensor:
        return windows[:, : self.net.spec.observe]

    def save(self, path: Path, extra: dict[str, Any] | None = None) -> None:
        """Write the whole state atomically; `extra` is given back by `restore`."""
        tensors = {"random": torch.get_rng_state()}
        for name, module in self._modules().items():
            tensors |= {f"{name}.{key}": value for key, value in module.state_dict().items()}
        for name, optimizer in self._optimizers().items():
            tensors |= _optimizer_tensors(name, optimizer)
        meta = {"step": self.step, "config": asdict(self.config), "extra": extra or {}}
        write_state(path, tensors, meta)

    def restore(self, path: Path) -> dict[str, Any]:
        """Go on from a saved state; give back what was saved as `extra`.

        Raises:
            ValueError: the state belongs to a run with other settings.
        """
        meta, tensors = parse_state(path)
        if meta["config"] != json.loads(json.dumps(asdict(self.config))):
            raise ValueError(
                f"{path} was left by a run with other settings; delete it to start over"
            )
        for name, module in self._modules().items():
            module.load_state_dict(_under(tensors, name))
        for name, optimizer in self._optimizers().items():
            _restore_optimizer(optimizer, _under(tensors, name))
        self.step = meta["step"]
        torch.set_rng_state(tensors["random"])
        extra: dict[str, Any] = meta["extra"]
        return extra

    def _modules(self) -> dict[str, nn.Module]:
        kept: dict[str, nn.Module] = {
            "net": self.net,
            "average": self.average,
            "adversary": self.adversary,
        }
        return kept if self.reader is None else kept | {"reader": self.reader}

    def _optimizers(self) -> dict[str, torch.optim.Optimizer]:
        return {"adamw": self.optimizer, "adam": self.adversary_optimizer}


def train(
    trainer: Trainer,
    *,
    validate: Callable[[Predictor], float | None],
    report: Callable[[Progress], None],
    state: Path | None = None,
    save_seconds: float = 30.0,
) -> Predictor:
    """Run to the last step (or to the end of patience) and give the averaged net.

    Args:
        trainer: fresh, or left by an earlier run of which `state` is the file.
        validate: error on people left out (cm²), or None where nobody was.
        report: called every step.
        state: file to save to now and then, and to resume from if it exists.
        save_seconds: time between saves.
    """
    config = trainer.config
    best: float | None = None
    since = 0
    if state is not None and state.exists():
        extra = trainer.restore(state)
        best, since = extra["best"], extra["since"]
    began = saved = monotonic()
    first = trainer.step
    while trainer.step < config.steps:
        loss, fooled = trainer.run_step()
        due = trainer.step % config.evaluate_every == 0 or trainer.step == config.steps
        score = validate(trainer.average) if due else None
        if score is not None:
            since = 0 if best is None or score < best else since + 1
            best = score if best is None else min(best, score)
        rate = (monotonic() - began) / (trainer.step - first)
        left = rate * (config.steps - trainer.step)
        report(Progress(trainer.step, config.steps, loss, fooled, score, left))
        if state is not None and (monotonic() - saved > save_seconds or due):
            trainer.save(state, {"best": best, "since": since})
            saved = monotonic()
        if config.patience is not None and since > config.patience:
            break
    return trainer.average.eval()


def draw_augmented(sampler: WindowSampler, augmentation: Augmentation, *, observe: int) -> Drawn:
    """Draw a batch and augment each pool by itself, so that only people of one are blended."""
    parts = [
        augment_labelled(part.windows, part.labels, augmentation, observe=observe)
        for part in sampler.draw()
    ]
    windows, labels = zip(*parts, strict=True)
    return Drawn(torch.cat(windows), torch.cat(labels))


def _fitting_windows(sampler: WindowSampler, config: PretrainConfig) -> Tensor:
    draws = [draw_augmented(sampler, config.augmentation, observe=sampler.length) for _ in range(8)]
    return torch.cat([drawn.windows for drawn in draws]).cpu()


def _under(tensors: dict[str, Tensor], name: str) -> dict[str, Tensor]:
    prefix = name + "."
    return {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}


def _optimizer_tensors(name: str, optimizer: torch.optim.Optimizer) -> dict[str, Tensor]:
    state = optimizer.state_dict()["state"]
    return {
        f"{name}.{i}.{key}": value for i, entry in state.items() for key, value in entry.items()
    }


def _restore_optimizer(optimizer: torch.optim.Optimizer, tensors: dict[str, Tensor]) -> None:
    state: dict[int, dict[str, Tensor]] = {}
    for name, value in tensors.items():
        index, key = name.split(".", 1)
        state.setdefault(int(index), {})[key] = value
    groups = optimizer.state_dict()["param_groups"]
    optimizer.load_state_dict({"state": state, "param_groups": groups})
