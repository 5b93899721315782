"""Nets that are small enough to be trained and run in a test."""

from models.predictor import NetConfig

TINY = NetConfig(
    encoder_hidden=8,
    encoder_heads=2,
    continuous=4,
    categories=3,
    decoder_token=4,
    decoder_hidden=8,
    decoder_heads=2,
    spl_hidden=4,
)
SMALL = NetConfig(
    encoder_hidden=16,
    encoder_heads=2,
    continuous=16,
    categories=5,
    decoder_token=8,
    decoder_hidden=16,
    decoder_heads=2,
    spl_hidden=8,
)
