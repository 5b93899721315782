from dataclasses import replace

import pytest

from models.data.augment import Augmentation
from models.training.config import PretrainConfig
from tests.nets import TINY


@pytest.fixture
def config() -> PretrainConfig:
    """Four steps of a tiny net in which the adversarial game begins at the second."""
    return replace(
        PretrainConfig(),
        net=replace(TINY, dropout=0.1),
        augmentation=Augmentation(mix=0.5),
        steps=4,
        batch=12,
        adversarial_start=0.25,
        evaluate_every=2,
    )
