"""A peer's weights as safetensors with readable metadata; nothing here can run code from a file."""

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safetensors.torch import save as save_tensors

from models.baselines.simlpe import Simlpe, SimlpeSizes
from models.checkpoint import CheckpointError, parse_blob, write_atomically
from models.skeleton import KINECT_V1
from models.spec import MotionSpec

FORMAT = "kinecast-simlpe-1"


@dataclass(frozen=True, slots=True)
class SimlpeFile:
    """A loaded peer.

    Attributes:
        net: in evaluation mode.
        metadata: spec, sizes, skeleton, settings and data of its training, command, scores.
        sha256: of the whole file.
    """

    net: Simlpe
    metadata: dict[str, Any]
    sha256: str


def save_simlpe(path: Path, net: Simlpe, metadata: dict[str, Any]) -> str:
    """Write a peer atomically and give the file's sha256; the same input gives the same bytes."""
    described = {"format": FORMAT, "skeleton": list(KINECT_V1.joints), **net.describe(), **metadata}
    tensors = {name: tensor.contiguous() for name, tensor in net.state_dict().items()}
    blob = save_tensors(tensors, metadata={"kinecast": json.dumps(described, sort_keys=True)})
    return write_atomically(path, blob)


def load_simlpe(path: Path) -> SimlpeFile:
    """Read a peer.

    Raises:
        CheckpointError: the file is none, or not one that this version can read.
        OSError: it cannot be read.
    """
    blob = path.read_bytes()
    metadata, tensors = parse_blob(blob)
    if metadata.get("format") != FORMAT or metadata.get("skeleton") != list(KINECT_V1.joints):
        raise CheckpointError(
            f"format {metadata.get('format')!r} is not {FORMAT!r} of our skeleton"
        )
    try:
        net = Simlpe(MotionSpec(**metadata["spec"]), SimlpeSizes(**metadata["config"]))
        net.load_state_dict(tensors)
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise CheckpointError(f"no peer of this version is described: {error}") from error
    net.eval().requires_grad_(requires_grad=False)
    return SimlpeFile(net, metadata, hashlib.sha256(blob).hexdigest())
