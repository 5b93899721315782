"""The bases of the studies: who trained them, by what recipe; trained once, found again by name.

Files lie in `build/studies/bases`. What a base is called in the key of a row is the sha256 of its
file, which the rows of `bases.jsonl` keep, so that results can be read where the files are not.
"""

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from time import monotonic
from typing import Any

from benchmarks.studies.ablations import (
    FORMAT,
    PARTS,
    SQUARED_LOSS,
    ablate,
    make_trainer,
    without_augmentation,
)
from benchmarks.studies.cache import RESULTS, Cache, Row, locked, make_key
from benchmarks.studies.peers import SIMLPE, train_simlpe_file
from benchmarks.studies.recordings import (
    COLLECTIONS,
    UTD,
    Place,
    hash_collection,
    is_examinee,
    read_collection,
)
from models.checkpoint import (
    SHIPPED,
    CheckpointError,
    dump_checkpoint,
    load_checkpoint,
    parse_blob,
    write_atomically,
)
from models.data.clips import Clip
from models.predictor import NetConfig, Predictor
from models.training.config import PretrainConfig
from models.training.loop import Progress
from models.training.pretrain import Pretrained, current_commit, pretrain
from models.training.simlpe import SimlpeConfig

FOLDER = Path("build/studies/bases")
FULL_STEPS = PretrainConfig().steps
BUDGET_STEPS, ABLATION_STEPS = 1_200, 600
"""About five minutes of a core, and two and a half: enough to compare by, see training/LOG.md."""
STEP_S, PEER_STEP_S = 0.3, 0.09
"""A step on one core, about."""
SHIPPED_BASE = "shipped-0"
LEFT_OUT_OF_ABLATIONS = "utd-mhad/7"
FULL_ABLATION = "ablation-every-part"
"""The base with every part that ablations are compared with."""
_VERSION = 1


@dataclass(frozen=True, slots=True)
class Recipe:
    """How a base comes about.

    Attributes:
        name: what studies call it.
        config: of our net, or of a peer.
        sources: collections that train, as far as their people train at all.
        left_out: people ("utd-mhad/7") and collections ("wmft") that do not.
        part: of the net or objective that is taken away, see `ablations`.
    """

    name: str
    config: PretrainConfig | SimlpeConfig
    sources: tuple[str, ...] = COLLECTIONS
    left_out: tuple[str, ...] = ()
    part: str = ""

    def select(self, place: Place) -> list[Clip]:
        """Give the clips to train on."""
        return [
            clip
            for source in self.sources
            if source not in self.left_out
            for clip in read_collection(place, source)
            if not is_examinee("/".join(clip.person)) and "/".join(clip.person) not in self.left_out
        ]

    def key(self, place: Place) -> str:
        """Name the base by everything that decides it."""
        used = [source for source in self.sources if source not in self.left_out]
        return make_key(
            {
                "version": _VERSION,
                "config": asdict(self.config),
                "left_out": self.left_out,
                "part": self.part,
                "data": {source: hash_collection(place, source) for source in used},
            }
        )

    def path(self, place: Place) -> Path:
        """Say where the file is, or will be."""
        if self.name == SHIPPED_BASE:
            return SHIPPED
        return FOLDER / f"{self.name}-{self.key(place)}.safetensors"

    @property
    def seconds(self) -> float:
        """How long it takes on one core, about."""
        step_s = STEP_S if isinstance(self.config, PretrainConfig) else PEER_STEP_S
        return step_s * self.config.steps


def list_recipes() -> dict[str, Recipe]:
    """Give every base by its name."""
    return {recipe.name: recipe for recipe in _list_recipes()}


def _list_recipes() -> Iterator[Recipe]:
    full = PretrainConfig()
    for seed in range(3):
        yield Recipe(f"shipped-{seed}", replace(full, seed=seed))
    for seed in range(3):
        yield Recipe(f"paper-{seed}", replace(full, seed=seed), sources=(UTD,))
    for seed in range(3):
        peer = replace(SimlpeConfig(), seed=seed)
        yield Recipe(f"{SIMLPE}-shipped-{seed}", peer)
        yield Recipe(f"{SIMLPE}-paper-{seed}", peer, sources=(UTD,))
    budget = replace(full, steps=BUDGET_STEPS, evaluate_every=BUDGET_STEPS)
    for left_out in (*(f"{UTD}/{subject}" for subject in (3, 7, 1, 5)), *COLLECTIONS):
        name = f"without-{left_out.replace('/', '-')}"
        yield Recipe(name, budget, left_out=(left_out,))
    budget = replace(full, steps=ABLATION_STEPS, evaluate_every=ABLATION_STEPS)
    yield Recipe(FULL_ABLATION, budget, left_out=(LEFT_OUT_OF_ABLATIONS,))
    for name, (config, part) in _list_ablations(budget).items():
        yield Recipe(name, config, left_out=(LEFT_OUT_OF_ABLATIONS,), part=part)


def _list_ablations(full: PretrainConfig) -> dict[str, tuple[PretrainConfig, str]]:
    """Say what each ablation trains, and which part of the net or objective it takes away."""
    parts = {f"no-{part}": (full, part) for part in (*PARTS, SQUARED_LOSS)}
    parts["no-c"] = (replace(full, label_weight=0.0), "c")
    settings = {
        "no-adversary": replace(full, adversarial_weight=0.0),
        "no-symmetry": replace(full, symmetric=False),
        "no-canonical-heading": replace(full, net=replace(full.net, canonical_heading=False)),
        "no-labels": replace(full, label_weight=0.0, moment_weight=0.0),
        "no-moments": replace(full, moment_weight=0.0),
        "no-mixup": without_augmentation(full, "mix"),
        "no-sensor": without_augmentation(full, "tilt_rad", "offset_m", "bones", "noise_m"),
        "no-tempo": without_augmentation(full, "tempo", "slow"),
        "no-postures": without_augmentation(full, "posture", "movement", "travel"),
        "no-average": replace(full, average=0.0),
    }
    found = parts | {name: (one, "") for name, one in settings.items()}
    return {f"ablation-{name}": value for name, value in found.items()}


def find_sha256(recipe: Recipe, place: Place) -> str | None:
    """Name the file of a base, as it is or once was; None where it was never trained."""
    path = recipe.path(place)
    if path.exists():
        return hashlib.sha256(path.read_bytes()).hexdigest()
    key = recipe.key(place)
    rows = [row for row in Cache(RESULTS / "bases.jsonl").read().values() if row["recipe"] == key]
    return str(rows[-1]["sha256"]) if rows else None


def train_base(recipe: Recipe, place: Place) -> Row:
    """Train a base, or go on where a killed run was; give its row.

    A base that is there is not trained again.
    """
    path, began = recipe.path(place), monotonic()
    path.parent.mkdir(parents=True, exist_ok=True)
    steps: list[int] = []
    with locked(path.with_suffix(".lock")):
        if not path.exists():  # nor did another process train it meanwhile
            _train(recipe, place, path, lambda progress: steps.append(progress.step))
    blob = path.read_bytes()
    metadata = parse_blob(blob)[0]
    return {
        "recipe": recipe.key(place),
        "sha256": hashlib.sha256(blob).hexdigest(),
        "steps": recipe.config.steps,
        "steps_of_this_run": len(steps),
        "training_s": round(monotonic() - began, 1),
        "data": metadata["data"],
        "left_out": list(recipe.left_out),
        "commit": current_commit(),
        "torch": metadata["torch"],
    }


def _train(recipe: Recipe, place: Place, path: Path, report: Callable[[Progress], None]) -> None:
    """Train and write a base or a peer."""
    clips, config = recipe.select(place), recipe.config
    if isinstance(config, SimlpeConfig):
        train_simlpe_file(path, clips, config, about=_name(recipe), report=report)
        return
    state = path.with_suffix(".state")
    trainer = make_trainer(recipe.part)
    trained = pretrain(clips, config, state=state, report=report, trainer_type=trainer)
    write_atomically(path, _dump(recipe, trained))
    state.unlink(missing_ok=True)


def _name(recipe: Recipe) -> dict[str, Any]:
    return {"left_out": list(recipe.left_out), "study": recipe.name}


def _dump(recipe: Recipe, trained: Pretrained) -> bytes:
    """Give the file: without times and commits, so that equal weights are equal files."""
    kept = ("pretraining", "steps_run", "data", "data_sha256", "torch")
    metadata: dict[str, Any] = {name: trained.metadata[name] for name in kept}
    metadata |= _name(recipe)
    if recipe.part:
        metadata |= {"format": FORMAT, "part": recipe.part}
    return dump_checkpoint(trained.predictor, metadata, adversary=trained.adversary)


def load_net(blob: bytes) -> Predictor:
    """Load the net of a base, a part of which may have been taken away."""
    if parse_blob(blob)[0].get("format") == FORMAT:
        return load_ablated(blob)
    return load_checkpoint(blob).predictor


def load_ablated(blob: bytes) -> Predictor:
    """Load the net of an ablation, of which files are in a format of their own."""
    metadata, tensors = parse_blob(blob)
    if metadata.get("format") != FORMAT:
        raise CheckpointError(f"format {metadata.get('format')!r} is not {FORMAT!r}")
    net = ablate(Predictor(config=NetConfig(**metadata["config"])), metadata["part"])
    state = {name.removeprefix("net."): t for name, t in tensors.items() if name.startswith("net.")}
    net.load_state_dict(state)
    return net.eval().requires_grad_(requires_grad=False)
