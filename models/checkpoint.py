"""Weights as safetensors with readable metadata; nothing here can run code from a file."""

import copy
import hashlib
import json
import os
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import safetensors
import torch
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torch import Tensor, nn

from models.baselines import Forecaster
from models.correction import Correction
from models.decoder import Decoder
from models.familiarity import Familiarity
from models.latent import Adversary
from models.personal import PersonalDecoder
from models.predictor import NetConfig, Predictor
from models.skeleton import KINECT_V1
from models.spec import MotionSpec
from models.uncertainty import RadiusTable

FORMAT, PERSONAL_FORMAT = "kinecast-base-1", "kinecast-personal-2"
UNCORRECTED_FORMAT = "kinecast-personal-1"
"""Of personal versions before corrections were a part of them."""
SHIPPED = Path(__file__).parent / "pretrained" / "base.safetensors"
_NET, _ADVERSARY, _RADIUS = "net.", "adversary.", "radius"
_PERSONAL_DTYPES = {torch.float32, torch.bfloat16, torch.float16}
_DECODER, _FAMILIARITY, _CORRECTION = "decoder.", "familiarity.", "correction."


class CheckpointError(ValueError):
    """A file that is no checkpoint of ours, or not one that this version can read."""


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """A loaded base model.

    Attributes:
        predictor: the net, in evaluation mode.
        metadata: spec, sizes, skeleton, data hash, command, commit, scores (see docs/model.md).
        sha256: of the whole file; names these weights everywhere.
        radius: calibrated radius per frame and joint, if the file holds one.
        adversary: the two discriminators, if the net was trained against them.
    """

    predictor: Predictor
    metadata: dict[str, Any]
    sha256: str
    radius: RadiusTable | None
    adversary: Adversary | None


def dump_checkpoint(
    predictor: Predictor,
    metadata: dict[str, Any],
    *,
    radius: RadiusTable | None = None,
    adversary: Adversary | None = None,
) -> bytes:
    """Serialise a net with its metadata; the same input gives the same bytes.

    What 16 bits hold without loss is stored in 16 bits.
    """
    tensors = {_NET + name: _shrink(t) for name, t in predictor.state_dict().items()}
    if adversary is not None:
        state = adversary.state_dict()
        tensors |= {_ADVERSARY + name: t.contiguous() for name, t in state.items()}
    described = {"format": FORMAT, "skeleton": list(KINECT_V1.joints), **predictor.describe()}
    described |= metadata
    if radius is not None:
        tensors[_RADIUS] = torch.from_numpy(radius.table).contiguous()
        described["radius"] = radius.describe()
    return save_tensors(tensors, metadata={"kinecast": json.dumps(described, sort_keys=True)})


def save_checkpoint(
    path: Path,
    predictor: Predictor,
    metadata: dict[str, Any],
    *,
    radius: RadiusTable | None = None,
    adversary: Adversary | None = None,
) -> str:
    """Write a checkpoint atomically and give its sha256."""
    blob = dump_checkpoint(predictor, metadata, radius=radius, adversary=adversary)
    return write_atomically(path, blob)


def write_atomically(path: Path, blob: bytes) -> str:
    """Replace a file by whole new content, so that a kill leaves the old or the new one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(path.name + ".part")
    with draft.open("wb") as file:
        file.write(blob)
        file.flush()
        os.fsync(file.fileno())
    draft.replace(path)
    return hashlib.sha256(blob).hexdigest()


def load_checkpoint(source: Path | bytes) -> Checkpoint:
    """Read a checkpoint from a file or from its bytes.

    Raises:
        CheckpointError: not safetensors, not our format, another skeleton or shape, or a bad table
            of radii.
        OSError: the file cannot be read.
    """
    blob = source if isinstance(source, bytes) else source.read_bytes()
    metadata, tensors = parse_blob(blob)
    predictor = _build(metadata)
    _fill(predictor, tensors, _NET)
    radius, adversary = None, None
    if _RADIUS in tensors:
        radius = _restore_radius(tensors[_RADIUS], metadata, predictor.spec)
    if any(name.startswith(_ADVERSARY) for name in tensors):
        size = predictor.config
        try:
            hidden = int(metadata["pretraining"]["adversary_hidden"])
        except (KeyError, TypeError, ValueError) as error:
            raise CheckpointError(f"the discriminators are not described: {error!r}") from error
        adversary = Adversary(continuous=size.continuous, categories=size.categories, hidden=hidden)
        _fill(adversary, tensors, _ADVERSARY)
    return Checkpoint(predictor, metadata, hashlib.sha256(blob).hexdigest(), radius, adversary)


def dump_personal(
    decoder: Decoder,
    metadata: dict[str, Any],
    *,
    base_sha256: str,
    familiarity: Familiarity | None = None,
    correction: Correction | None = None,
) -> bytes:
    """Serialise one person's decoder; the same input gives the same bytes.

    What 16 bits hold without loss is stored in 16 bits.
    """
    tensors = {_DECODER + name: _shrink(t) for name, t in decoder.state_dict().items()}
    described = {"format": PERSONAL_FORMAT, "base_sha256": base_sha256} | metadata
    if familiarity is not None:
        tensors |= {
            _FAMILIARITY + name: t.contiguous() for name, t in familiarity.tensors().items()
        }
        described["familiarity"] = familiarity.describe()
    if correction is not None:
        tensors |= {_CORRECTION + name: t.contiguous() for name, t in correction.tensors().items()}
        described["correction"] = correction.describe()
    return save_tensors(tensors, metadata={"kinecast": json.dumps(described, sort_keys=True)})


def _shrink(tensor: Tensor) -> Tensor:
    for small in (tensor.bfloat16(), tensor.half()):
        if torch.equal(small.float(), tensor):
            return small.contiguous()
    return tensor.contiguous()


def load_personal(blob: bytes, base: Forecaster, *, base_sha256: str) -> PersonalDecoder:
    """Read one person's decoder, to run behind the base that it was fitted on.

    Args:
        blob: as `dump_personal` makes it.
        base: the base model.
        base_sha256: what its weights are called.

    Raises:
        CheckpointError: not such a file, fitted on another base, or weights that are not finite.
    """
    metadata, tensors = parse_blob(blob)
    if metadata.get("format") not in (PERSONAL_FORMAT, UNCORRECTED_FORMAT):
        raise CheckpointError(f"format {metadata.get('format')!r} is not {PERSONAL_FORMAT!r}")
    if metadata.get("base_sha256") != base_sha256:
        raise CheckpointError(f"fitted on the base {metadata.get('base_sha256')}")
    if not isinstance(base, Predictor):
        raise CheckpointError("the base has no decoder that could be exchanged")
    unknown = {tensor.dtype for tensor in tensors.values()} - _PERSONAL_DTYPES
    if unknown:
        raise CheckpointError(f"weights of a kind that no version has: {sorted(map(str, unknown))}")
    if not all(bool(tensor.isfinite().all()) for tensor in tensors.values()):
        raise CheckpointError("the weights are not finite")
    decoder = copy.deepcopy(base.decoder)
    _fill(decoder, tensors, _DECODER)
    familiarity = _restore_familiarity(tensors, metadata, base.config.continuous)
    correction = _restore_correction(tensors, metadata, familiarity, base.spec)
    return PersonalDecoder(base, decoder, familiarity, metadata, correction)


def write_state(path: Path, tensors: dict[str, Tensor], meta: dict[str, Any]) -> None:
    """Save the state of a training run atomically (same container as a checkpoint)."""
    whole = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in tensors.items()}
    write_atomically(path, save_tensors(whole, metadata={"kinecast": json.dumps(meta)}))


def parse_state(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Read a state written by `write_state`."""
    return parse_blob(path.read_bytes())


def parse_blob(blob: bytes) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Split a safetensors blob into our metadata and its tensors."""
    try:
        tensors = load_tensors(blob)
        header = json.loads(blob[8 : 8 + int.from_bytes(blob[:8], "little")])
        metadata = json.loads(header["__metadata__"]["kinecast"])
    except (
        safetensors.SafetensorError,
        KeyError,
        UnicodeDecodeError,
        json.JSONDecodeError,
    ) as error:
        raise CheckpointError(f"not a Kinecast checkpoint: {error}") from error
    if not isinstance(metadata, dict):
        raise CheckpointError("not a Kinecast checkpoint: its metadata is no object")
    return metadata, tensors


def _fill(net: nn.Module, tensors: dict[str, Tensor], prefix: str) -> None:
    try:
        net.load_state_dict(_pick(tensors, prefix))
    except RuntimeError as error:
        raise CheckpointError(
            f"the weights do not fit the net they claim to be: {error}"
        ) from error
    net.eval().requires_grad_(requires_grad=False)


def _restore_familiarity(
    tensors: dict[str, Tensor], metadata: dict[str, Any], continuous: int
) -> Familiarity | None:
    found = _pick(tensors, _FAMILIARITY)
    if not found and "familiarity" not in metadata:
        return None
    try:
        familiarity = Familiarity.restore(found, metadata["familiarity"])
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(f"bad model of familiarity: {error}") from error
    if len(familiarity.mean) != continuous:
        raise CheckpointError(f"familiarity must be in a latent of {continuous} dimensions")
    return familiarity


def _restore_correction(
    tensors: dict[str, Tensor],
    metadata: dict[str, Any],
    familiarity: Familiarity | None,
    spec: MotionSpec,
) -> Correction | None:
    found = _pick(tensors, _CORRECTION)
    if not found and "correction" not in metadata:
        return None
    if familiarity is None:
        raise CheckpointError("a correction without a model of familiarity")
    points, coordinates = len(familiarity.points), 3 * spec.horizon * spec.joints
    try:
        described = metadata["correction"]
        return Correction.restore(found, described, points=points, coordinates=coordinates)
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(f"bad correction: {error}") from error


def _pick(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """Give the tensors of one part."""
    return {
        name.removeprefix(prefix): tensor
        for name, tensor in tensors.items()
        if name.startswith(prefix)
    }


def _restore_radius(table: Tensor, metadata: dict[str, Any], spec: MotionSpec) -> RadiusTable:
    if table.dtype != torch.float32 or table.shape[1:] != (spec.horizon, spec.joints):
        raise CheckpointError(
            f"a table of radii must be float32 of levels x {spec.horizon} x {spec.joints}, "
            f"not {table.dtype} of {' x '.join(map(str, table.shape))}"
        )
    try:
        return RadiusTable.restore(table.numpy(), metadata["radius"])
    except KeyError as error:
        raise CheckpointError(f"the table of radii is not described: {error} is missing") from error
    except (TypeError, ValueError) as error:
        raise CheckpointError(f"bad table of radii: {error}") from error


def _build(metadata: dict[str, Any]) -> Predictor:
    if metadata.get("format") != FORMAT:
        raise CheckpointError(f"format {metadata.get('format')!r} is not {FORMAT!r}")
    if metadata.get("skeleton") != list(KINECT_V1.joints):
        raise CheckpointError("the checkpoint was trained on another skeleton")
    known = {field.name for field in fields(NetConfig)}
    try:
        unknown = set(metadata["config"]) - known
        if unknown:
            raise CheckpointError(f"sizes unknown to this version: {sorted(unknown)}")
        return Predictor(MotionSpec(**metadata["spec"]), NetConfig(**metadata["config"]))
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise CheckpointError(f"no net of this version is described: {error!r}") from error
