"""A small base model without training, so that a fit takes a second; its blobs are still large."""

from pathlib import Path

import torch

from models.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from models.predictor import NetConfig, Predictor

SMALL = NetConfig(
    encoder_hidden=16,
    encoder_heads=2,
    continuous=16,
    categories=5,
    decoder_token=32,
    decoder_hidden=96,
    spl_hidden=24,
)


def make_base(path: Path) -> Checkpoint:
    """Write it to a file, the same every time."""
    torch.manual_seed(0)
    save_checkpoint(path, Predictor(config=SMALL), {})
    return load_checkpoint(path)
