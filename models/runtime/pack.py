"""Weights laid out for the kernel in `native/`: in the order in which it reads them.

A matrix becomes tiles of 64 outputs; in each tile the 64 weights of one input after those of the
one before, so that a product reads memory in one direction. Weights that half precision holds
without loss are kept in half precision: they are half as many bytes to read in every frame.
"""

import struct
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from models.decoder import Decoder
from models.encoder import STREAMS, TokenAttention
from models.familiarity import Familiarity
from models.normalize import HEADING_FRAMES, MIN_ACROSS_M
from models.predictor import Predictor
from models.skeleton import (
    HIP_CENTER,
    KINECT_V1,
    LEFT_HIP,
    LEFT_SHOULDER,
    RIGHT_HIP,
    RIGHT_SHOULDER,
    topological_levels,
)

TILE = 64
ROWS = 4
"""Windows that share a pass over shared weights."""
ALIGNMENT = 64
MAX_JOINTS = 32
_MAGIC = 0x4B494E45

Packed = np.ndarray


@dataclass(frozen=True, eq=False)
class PackedBase:
    """A base as the kernel reads it.

    Attributes:
        shape: sizes and kinematic tree.
        encoder, decoder: the weights.
        observe, horizon: frames of a window and of a forecast.
        encoder_frame_bytes, decoder_frame_bytes: of the weights that are read again for every
            frame, in single precision.
    """

    shape: bytes
    encoder: Packed
    decoder: Packed
    observe: int
    horizon: int
    encoder_frame_bytes: int
    decoder_frame_bytes: int


def pack_base(base: Predictor) -> PackedBase:
    """Lay a base out."""
    streams, decoder = base.encoder.streams, base.decoder
    once = (decoder.start, decoder.token_z, decoder.token_c)
    return PackedBase(
        shape=_pack_shape(base),
        encoder=_pack_encoder(base),
        decoder=pack_decoder(decoder),
        observe=base.spec.observe,
        horizon=base.spec.horizon,
        encoder_frame_bytes=4 * _count(streams),
        decoder_frame_bytes=4 * (_count(decoder) - sum(map(_count, once))),
    )


def pack_decoder(decoder: Decoder, *, half: bool | None = None) -> Packed:
    """Lay a decoder out.

    Args:
        decoder: one person's, or the base's.
        half: whether matrices are kept in half precision; None: if that loses nothing.
    """
    matrices = [matrix.detach().numpy() for matrix in _list_matrices(decoder)]
    if half is None:
        half = all(is_half(matrix) for matrix in matrices)
    kind = np.float16 if half else np.float32
    vectors = np.concatenate([vector.detach().numpy() for vector in _list_vectors(decoder)])
    parts = [
        struct.pack("<2i", _MAGIC, half).ljust(ALIGNMENT, b"\0"),
        vectors.astype(np.float32).tobytes(),
        *(matrix.astype(kind).tobytes() for matrix in matrices),
    ]
    return _align(b"".join(parts))


def pack_gate(gate: Familiarity) -> Packed:
    """Lay a model of familiarity out: points side by side, sixteen at a time."""
    mean, axes, points = (part.numpy() for part in (gate.mean, gate.axes, gate.points))
    directions = axes.shape[1]
    header = np.zeros(16, np.float32)
    header[:4] = directions, len(points), gate.rule.half, gate.rule.width
    sixteen = np.full((_pad(len(points), 16), directions), 1e18, np.float32)
    sixteen[: len(points)] = points
    tiles = sixteen.reshape(-1, 16, directions).transpose(0, 2, 1)
    parts = [
        header,
        np.pad(mean, (0, _pad(len(mean), 16) - len(mean))),
        np.pad(axes, ((0, 0), (0, _pad(directions, 16) - directions))),
        tiles,
    ]
    return _align(b"".join(np.ascontiguousarray(part, np.float32).tobytes() for part in parts))


@torch.no_grad()
def round_to_half(decoder: Decoder) -> None:
    """Round a decoder's matrices to numbers that half precision holds, so that none is lost."""
    tree, cell, attention = decoder.predict, decoder.cell, decoder.attention
    for matrix in (
        decoder.start.weight,
        decoder.token_z.weight,
        decoder.token_c.weight,
        decoder.token_h.weight,
        attention.project.weight,
        attention.mix.weight,
        cell.weight_ih,
        cell.weight_hh,
        tree.from_state.weight,
        *tree.from_ancestors,
        tree.to_offset,
    ):
        matrix.copy_(matrix.half().float())


def is_half(values: Float[np.ndarray, "..."]) -> bool:
    """Tell whether half precision holds these numbers without loss."""
    with np.errstate(over="ignore"):
        return bool((values.astype(np.float16).astype(np.float32) == values).all())


def _pack_shape(base: Predictor) -> bytes:
    order, parent, depth = _walk(KINECT_V1.parents)
    spec, size, scales = base.spec, base.config, base.normalizer.scales
    sizes = (
        spec.observe,
        spec.horizon,
        spec.joints,
        size.encoder_hidden,
        size.encoder_heads,
        size.continuous,
        size.categories,
        size.decoder_token,
        size.decoder_hidden,
        size.decoder_heads,
        size.spl_hidden,
        HIP_CENTER,
        LEFT_HIP,
        RIGHT_HIP,
        LEFT_SHOULDER,
        RIGHT_SHOULDER,
        HEADING_FRAMES,
        int(size.canonical_heading),
    )
    tree = [joint for part in (order, parent, depth) for joint in _fill(part, MAX_JOINTS)]
    mean = _fill(base.normalizer.mean_pose.flatten().tolist(), 3 * MAX_JOINTS)
    numbers = (MIN_ACROSS_M, *scales.tolist(), *mean)
    return struct.pack(f"<{len(sizes) + len(tree)}i{len(numbers)}f", *sizes, *tree, *numbers)


def _walk(parents: tuple[int, ...]) -> tuple[list[int], list[int], list[int]]:
    """Give joints parents first, where each one's parent stands in that order, and its depth."""
    levels = topological_levels(parents)
    order = [joint for level in levels for joint in level]
    depth = [i for i, level in enumerate(levels) for _ in level]
    parent = [order.index(parents[joint]) if parents[joint] >= 0 else 0 for joint in order]
    return order, parent, depth


def _pack_encoder(base: Predictor) -> Packed:
    encoder, latent = base.encoder, base.latent
    parts: list[Tensor] = []
    for name in STREAMS:
        cell = dict(encoder.streams[name].named_parameters())
        parts += _join_biases(cell["bias_ih_l0"], cell["bias_hh_l0"], encoder.hidden)
        parts += [_tile(cell["weight_ih_l0"]), _tile(cell["weight_hh_l0"])]
    attention = encoder.attention
    parts += _list_attention_vectors(attention)
    parts += [_pad_vector(latent.to_z.bias), _pad_vector(latent.to_c.bias)]
    parts += [_tile(attention.project.weight), _tile(attention.mix.weight)]
    parts += [_tile(latent.to_z.weight), _tile(latent.to_c.weight)]
    return _align(b"".join(part.detach().numpy().tobytes() for part in parts))


def _list_vectors(decoder: Decoder) -> list[Tensor]:
    tree = decoder.predict
    return [
        decoder.start.bias,
        decoder.token_z.bias,
        decoder.token_c.bias,
        decoder.token_h.bias,
        *_list_attention_vectors(decoder.attention),
        *_join_biases(decoder.cell.bias_ih, decoder.cell.bias_hh, decoder.cell.hidden_size),
        _pad_vector(tree.from_state.bias),
        _pad_vector(tree.bias.flatten()),
    ]


def _list_matrices(decoder: Decoder) -> list[Tensor]:
    """List the matrices, as the kernel wants them.

    What the cell is given are attended tokens first, then the pose; torch has them the other way.
    """
    tree, cell = decoder.predict, decoder.cell
    pose = 3 * tree.joints
    given = torch.cat([cell.weight_ih[:, pose:], cell.weight_ih[:, :pose]], dim=1)
    return [
        _tile(decoder.start.weight),
        _tile(decoder.token_z.weight),
        _tile(decoder.token_c.weight),
        _tile(decoder.token_h.weight),
        _tile(decoder.attention.project.weight),
        _tile(decoder.attention.mix.weight),
        _tile(given),
        _tile(cell.weight_hh),
        _tile(tree.from_state.weight),
        *(level.flatten() for level in tree.from_ancestors),
        tree.to_offset.transpose(1, 2).contiguous().flatten(),
    ]


def _list_attention_vectors(attention: TokenAttention) -> list[Tensor]:
    norm: nn.LayerNorm = attention.norm
    return [attention.project.bias, attention.mix.bias, norm.weight, norm.bias]


def _join_biases(given: Tensor, kept: Tensor, size: int) -> list[Tensor]:
    """Give a cell's biases: of both sides together for two gates, apart for the third."""
    return [given[: 2 * size] + kept[: 2 * size], given[2 * size :], kept[2 * size :]]


def _tile(matrix: Float[Tensor, "output input"]) -> Float[Tensor, " weight"]:
    outputs, inputs = matrix.shape
    room = torch.zeros(_pad(outputs, TILE), _pad(inputs, 2))
    room[:outputs, :inputs] = matrix.detach()
    return room.view(-1, TILE, room.shape[1]).transpose(1, 2).contiguous().flatten()


def _count(part: nn.Module) -> int:
    return sum(weight.numel() for weight in part.parameters())


def _pad_vector(vector: Tensor) -> Tensor:
    return nn.functional.pad(vector, (0, _pad(len(vector), TILE) - len(vector)))


def _pad(count: int, to: int) -> int:
    return -(-count // to) * to


def _fill(values: list[int] | list[float], count: int) -> list[int] | list[float]:
    return [*values, *([0] * (count - len(values)))]


def _align(block: bytes) -> Packed:
    """Copy a block to where a line of the cache begins."""
    room = np.empty(len(block) + ALIGNMENT, np.uint8)
    start = -room.ctypes.data % ALIGNMENT
    packed = room[start : start + len(block)]
    packed[:] = np.frombuffer(block, np.uint8)
    packed.flags.writeable = False
    return packed
