from pathlib import Path

import numpy as np
import pytest
import torch

from models.data.clips import Clip
from models.predictor import Predictor
from tests.nets import SMALL


def believable_motion(seed: int, frames: int) -> np.ndarray:
    """A standing body whose joints swing smoothly, each in its own way."""
    generator = np.random.default_rng(seed)
    rest = np.zeros((20, 3))
    rest[[0, 1, 2, 3], 1] = [1.7, 1.45, 1.15, 1.0]
    for side, joints in ((-1, (4, 5, 6, 7)), (1, (8, 9, 10, 11))):
        rest[list(joints), 0] = side * np.array([0.2, 0.45, 0.7, 0.78])
        rest[list(joints), 1] = 1.42
    for side, joints in ((-1, (12, 13, 14, 15)), (1, (16, 17, 18, 19))):
        rest[list(joints), 0] = side * 0.1
        rest[list(joints), 1] = [0.95, 0.5, 0.1, 0.05]
    time = np.arange(frames)[:, None, None] / 30
    rate = generator.uniform(0.3, 1.2, (1, 20, 3))
    phase = generator.uniform(0, 2 * np.pi, (1, 20, 3))
    swing = generator.uniform(0, 0.08, (1, 20, 3)) * np.sin(2 * np.pi * rate * time + phase)
    return (rest + swing + [0.3, 0.0, 2.5]).astype(np.float32)


def make_clips(count: int, frames: int = 45, source: str = "utd-mhad") -> list[Clip]:
    return [
        Clip(believable_motion(i, frames), str(i % 3), f"action{i % 2}", "1", source)
        for i in range(count)
    ]


@pytest.fixture
def clips() -> list[Clip]:
    return make_clips(8)


@pytest.fixture
def synthetic_windows() -> torch.Tensor:
    return torch.stack([torch.from_numpy(believable_motion(i, 30)) for i in range(16)])


@pytest.fixture
def predictor() -> Predictor:
    """A small net whose output layer is not zero, as a fresh one's is."""
    torch.manual_seed(0)
    net = Predictor(config=SMALL)
    torch.nn.init.normal_(net.decoder.predict.to_offset, std=0.1)
    return net.eval()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path
