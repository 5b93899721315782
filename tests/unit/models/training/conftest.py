from dataclasses import replace

import pytest

from models.data.augment import Augmentation
from models.predictor import NetConfig
from models.training.config import PretrainConfig

TINY = NetConfig(
    encoder_hidden=8,
    encoder_heads=2,
    continuous=4,
    categories=3,
    decoder_token=4,
    decoder_hidden=8,
    decoder_heads=2,
    spl_hidden=4,
    dropout=0.1,
)


@pytest.fixture
def config() -> PretrainConfig:
    """Four steps of a tiny net in which the adversarial game begins at the second."""
    return replace(
        PretrainConfig(),
        net=TINY,
        augmentation=Augmentation(mix=0.5),
        steps=4,
        batch=12,
        adversarial_start=0.25,
        evaluate_every=2,
    )
