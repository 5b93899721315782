"""Weights laid out for the kernel in `native/`: in the order in which it reads them.

A matrix becomes tiles of 64 outputs; in each tile the 64 weights of one input after those of the
one before, so that a product reads memory in one direction. Weights that 16 bits hold without loss
are kept in 16 bits: they are half as many bytes to read in every frame.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from models.correction import Correction
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
BLOCK = 8
"""Windows that the encoder takes at once."""
ALIGNMENT = 64
MAX_JOINTS = 32
_MAGIC = 0x4B494E45

Packed = np.ndarray
Kind = Literal["float32", "float16", "bfloat16"]
KINDS: tuple[Kind, ...] = get_args(Kind)


@dataclass(frozen=True, eq=False)
class PackedBase:
    """A base as the kernel reads it.

    Attributes:
        shape: sizes and kinematic tree.
        encoder, decoder: the weights.
        observe, horizon: frames of a window and of a forecast.
        encoder_bytes: of the streams' weights as they are kept, as often as a block of windows
            reads them: what the frames meet once, what the state meets for every frame.
        encoder_multiplications: of all frames of a window, in the streams.
        decoder_frame_bytes: of the weights that are read again for every frame, in single
            precision.
    """

    shape: bytes
    encoder: Packed
    decoder: Packed
    observe: int
    horizon: int
    encoder_bytes: int
    encoder_multiplications: int
    decoder_frame_bytes: int

    @property
    def encoder_kind(self) -> Kind:
        """What the encoder's matrices are kept in."""
        return find_packed_kind(self.encoder)

    @property
    def is_folded(self) -> bool:
        """Whether its hidden matrices are kept for sums and differences of halves."""
        return _find_is_folded(self.encoder)


def pack_base(base: Predictor) -> PackedBase:
    """Lay a base out."""
    decoder, encoder = base.decoder, _pack_encoder(base)
    read, multiplied = _count_streams(
        base, find_packed_kind(encoder), is_folded=_find_is_folded(encoder)
    )
    once = (decoder.start, decoder.token_z, decoder.token_c)
    return PackedBase(
        shape=_pack_shape(base),
        encoder=encoder,
        decoder=pack_decoder(decoder),
        observe=base.spec.observe,
        horizon=base.spec.horizon,
        encoder_bytes=read,
        encoder_multiplications=multiplied,
        decoder_frame_bytes=4 * (_count(decoder) - sum(map(_count, once))),
    )


def pack_decoder(decoder: Decoder, *, kind: Kind | None = None) -> Packed:
    """Lay a decoder out.

    Args:
        decoder: one person's, or the base's.
        kind: what its matrices are kept in; None: in the shortest that loses nothing.
    """
    tiles = [matrix.detach().numpy() for matrix in _list_matrices(decoder)]
    fine = [matrix.detach().numpy() for matrix in _list_fine_matrices(decoder)]
    kind = kind or _find_kind([*tiles, *fine])
    width = np.float16 if kind == "float16" else np.float32
    return _align(
        _write(kind, _list_vectors(decoder), [_shorten(tile, kind) for tile in tiles])
        + b"".join(matrix.astype(width).tobytes() for matrix in fine)
    )


def find_packed_kind(packed: Packed) -> Kind:
    """Tell what the matrices of a decoder, or of an encoder, that was laid out are kept in."""
    _, number = struct.unpack_from("<2i", packed.data)
    return KINDS[int(number)]


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


def pack_correction(correction: Correction) -> Packed:
    """Lay a correction out, in 16 bits: the bumps of each point, then directions in tiles."""
    coefficients, basis = correction.coefficients.numpy(), correction.basis.numpy()
    points, rank = coefficients.shape
    room = _pad(rank, 16)
    header = np.zeros(16, np.float32)
    header[:4] = rank, points, correction.width, correction.part
    wide = np.pad(coefficients, ((0, 0), (0, room - rank)))
    coordinates = basis.shape[1]
    tall = np.pad(basis, ((0, room - rank), (0, _pad(coordinates, 16) - coordinates)))
    tiles = tall.reshape(room, -1, 16).transpose(1, 0, 2)
    parts = [np.ascontiguousarray(part, np.float16).tobytes() for part in (wide, tiles)]
    return _align(header.tobytes() + b"".join(parts))


def _find_is_folded(encoder: Packed) -> bool:
    return bool(struct.unpack_from("<3i", encoder.data)[2])


def _find_kind(matrices: Sequence[Float[np.ndarray, "..."]]) -> Kind:
    """Find the shortest kind of numbers that holds all of these without loss."""
    if all(_is_brief(matrix) for matrix in matrices):
        return "bfloat16"
    return "float16" if all(_is_half(matrix) for matrix in matrices) else "float32"


def _is_half(values: Float[np.ndarray, "..."]) -> bool:
    with np.errstate(over="ignore"):
        return bool((values.astype(np.float16).astype(np.float32) == values).all())


def _is_brief(values: Float[np.ndarray, "..."]) -> bool:
    return not (values.view(np.uint32) & 0xFFFF).any()


def _shorten(tiles: Float[np.ndarray, " weight"], kind: Kind) -> bytes:
    """Write matrices that are laid out in tiles as another kind of numbers.

    In bfloat16 weights of outputs that are 16 apart share a word, so that a shift makes floats of
    the ones, and a mask of the others.
    """
    if kind == "bfloat16":
        rounded = torch.from_numpy(tiles).bfloat16().view(torch.int16).numpy()
        return rounded.reshape(-1, 2, 16).transpose(0, 2, 1).tobytes()
    return tiles.astype(kind).tobytes()


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
    """Lay the encoder out, in 16 bits where that loses nothing."""
    encoder, latent, attention = base.encoder, base.latent, base.encoder.attention
    vectors: list[Tensor] = []
    matrices: list[Tensor] = []
    hidden: list[Tensor] = []
    for name in STREAMS:
        cell = dict(encoder.streams[name].named_parameters())
        vectors += _join_biases(cell["bias_ih_l0"], cell["bias_hh_l0"], encoder.hidden)
        matrices += [cell["weight_ih_l0"], cell["weight_hh_l0"]]
        hidden += [cell["weight_hh_l0"]]
    vectors += _list_attention_vectors(attention)
    vectors += [_pad_vector(latent.to_z.bias), _pad_vector(latent.to_c.bias)]
    matrices += [attention.project.weight, attention.mix.weight]
    matrices += [latent.to_z.weight, latent.to_c.weight]
    tiles = [_tile(matrix).numpy() for matrix in matrices]
    kind: Kind = "bfloat16" if all(map(_is_brief, tiles)) else "float32"
    is_folded = all(map(_is_symmetric, hidden))
    written = [_shorten(tile, kind) for tile in tiles]
    if is_folded:
        written[1 : 2 * len(hidden) : 2] = [_fold(matrix) for matrix in hidden]
    return _align(_write(kind, vectors, written, is_folded=is_folded))


def _halve(matrix: Float[Tensor, "output input"]) -> Float[Tensor, "gate to half from half"]:
    """Split a cell's matrix into gates and into the left and right halves of its units."""
    half = matrix.shape[1] // 2
    return matrix.detach().view(-1, 2, half, 2, half)


def _is_symmetric(matrix: Float[Tensor, "output input"]) -> bool:
    """Tell whether a matrix is the same when the halves of its units change places."""
    halves = _halve(matrix)
    return torch.equal(halves, halves.flip(1, 3))


def _fold(matrix: Float[Tensor, "output input"]) -> bytes:
    """Write a symmetric matrix for the sum and for the difference of the state's halves.

    These have more digits than 16 bits hold, but half the numbers: as many bytes, half the
    arithmetic.
    """
    halves = _halve(matrix)
    same, other = halves[:, 0, :, 0].flatten(0, 1), halves[:, 0, :, 1].flatten(0, 1)
    both = ((same + other) / 2, (same - other) / 2)
    return b"".join(_tile(part).numpy().tobytes() for part in both)


def _write(
    kind: Kind, vectors: Sequence[Tensor], matrices: Sequence[bytes], *, is_folded: bool = False
) -> bytes:
    """Write a header, vectors in single precision, and matrices as they are written already."""
    parts = [
        struct.pack("<3i", _MAGIC, KINDS.index(kind), is_folded).ljust(ALIGNMENT, b"\0"),
        *(vector.detach().numpy().astype(np.float32).tobytes() for vector in vectors),
        *matrices,
    ]
    return b"".join(parts)


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
    ]


def _list_fine_matrices(decoder: Decoder) -> list[Tensor]:
    """List the small matrices of the single joints, which are no tiles."""
    tree = decoder.predict
    return [
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


def _count_streams(base: Predictor, kind: Kind, *, is_folded: bool) -> tuple[int, int]:
    """Count the bytes that the streams read for a block, and what they multiply for a window.

    The state begins as zeros, and is multiplied with nothing in the first frame.
    """
    hidden, pose, frames = base.encoder.hidden, 3 * base.encoder.joints, base.spec.observe
    width = 4 if kind == "float32" else 2
    given, kept = (len(STREAMS) * 3 * hidden * inputs for inputs in (pose, hidden))
    if is_folded:
        kept //= 2
    again = (frames - 1) * kept
    return given * width + again * (4 if is_folded else width), given * frames + again


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
