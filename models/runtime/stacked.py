"""Forecasts on a GPU: everybody's decoder stacked in its memory, products over all at once.

A processor's cache holds one decoder, so the kernel in `native/` takes one person after the other.
A GPU has memory for thousands and is slow to start anything, so here a batch of people is one
batched product, and on CUDA the whole forecast is captured as a graph per size of batch: one
launch instead of a thousand. Numbers are those of `mixed.py` to 1e-5 m; any device of torch
works, a processor too, where it is slower than the kernel.
"""

import copy
import threading
import weakref
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor, nn
from torch.func import functional_call
from torch.nn import functional

from models.correction import RANK
from models.decoder import Decoder
from models.familiarity import DIRECTIONS, MOST_POINTS, SNAP
from models.personal import PersonalDecoder
from models.predictor import Encoded, Predictor
from models.runtime.mixed import centre

FIRST_ROWS = 64
LARGEST_BATCH = 64
"""More windows than this are several batches: they would not be faster as one."""
_BASE = 0
"""The row of the base: no share, so it needs no decoder of its own."""
_FAR = 1e6
"""Where points that pad a gate stand: nothing is near them."""
_stacks: "weakref.WeakKeyDictionary[Predictor, dict[str, Stack]]" = weakref.WeakKeyDictionary()
_stacking = threading.Lock()


@dataclass(frozen=True, slots=True, weakref_slot=True, eq=False)
class StackedDecoder:
    """One person's decoder in the memory of a device; called like every forecaster.

    Attributes:
        base: the net that it belongs to.
        stack: where it lies.
        row: in which place, until nobody holds this any more.
        metadata: what the file says about itself.
    """

    base: Predictor
    stack: "Stack"
    row: int
    metadata: dict[str, Any]

    def __call__(
        self, window: Float[Tensor, "batch observe joint 3"]
    ) -> Float[Tensor, "batch horizon joint 3"]:
        """Forecast the frames that follow each window: metres, in the frame of the input."""
        displacement, _ = self.stack.forecast(window.numpy(), [self] * len(window))
        return window[:, -1:] + torch.from_numpy(displacement)


@dataclass(eq=False)
class _Graph:
    """A forecast of some number of windows that was captured once and is replayed."""

    windows: Tensor
    rows: Tensor
    made: tuple[Tensor, Tensor]
    graph: "torch.cuda.CUDAGraph"


@dataclass(eq=False)
class _Slab:
    """Decoders, gates and corrections of everybody, each tensor with a row per person."""

    decoder: dict[str, Tensor]
    gate: dict[str, Tensor]
    correction: dict[str, Tensor]
    graphs: dict[int, _Graph] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.gate["half"])


class Stack:
    """A base and the decoders behind its encoder, on one device. Safe to use from any thread.

    Args:
        base: the shared net.
        device: where to compute, as torch names it.
    """

    def __init__(self, base: Predictor, device: str) -> None:
        self.device = torch.device(device)
        self._net = copy.deepcopy(base).to(self.device).eval().requires_grad_(requires_grad=False)
        self._one = _open_up(self._net.decoder)
        self._lock = threading.Lock()
        self._free: list[int] = list(range(FIRST_ROWS - 1, _BASE, -1))
        self._slab = self._allocate(FIRST_ROWS)

    def add(self, personal: PersonalDecoder) -> StackedDecoder:
        """Copy a person's decoder, gate and correction to the device.

        The place is given to somebody else once the decoder is held by nobody.

        Raises:
            RuntimeError: sizes that are not the base's, or no memory is left.
        """
        with self._lock, torch.inference_mode():
            if not self._free:
                self._grow()
            row = self._free.pop()  # at once: others come back at any moment, from any thread
            try:
                _write(self._slab.decoder, row, dict(personal.decoder.named_parameters()))
                _write(self._slab.gate, row, _lay_out_gate(personal))
                _write(self._slab.correction, row, _lay_out_correction(personal))
            except BaseException:
                self._free.append(row)
                raise
        decoder = StackedDecoder(personal.base, self, row, personal.metadata)
        weakref.finalize(decoder, self._free.append, row).atexit = False
        return decoder

    def forecast(
        self,
        windows: Float[np.ndarray, "batch observe joint 3"],
        decoders: Sequence[StackedDecoder | None],
    ) -> tuple[Float32[np.ndarray, "batch horizon joint 3"], Float32[np.ndarray, " batch"]]:
        """Forecast each window by its own version, all of which run behind one encoder.

        Args:
            windows: metres, y up.
            decoders: for each row whose decoder it is for; None for the base.

        Returns:
            Displacements from the last observed pose (metres, in the frame of the input), and the
            share of each row's personal decoder, 0 for the base.
        """
        given = centre(windows)
        rows = torch.tensor([_BASE if one is None else one.row for one in decoders])
        parts = zip(given.split(LARGEST_BATCH), rows.split(LARGEST_BATCH), strict=True)
        with self._lock, torch.inference_mode():
            made = [self._forecast_some(some, whose) for some, whose in parts]
        displacement, share = (torch.cat(part).numpy() for part in zip(*made, strict=True))
        return displacement, share

    def _forecast_some(self, windows: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Forecast at most `LARGEST_BATCH` windows, as a batch of one of few sizes."""
        count = len(windows)
        size = 1 << (count - 1).bit_length()
        windows = torch.cat([windows, windows[:1].expand(size - count, -1, -1, -1)])
        rows = functional.pad(rows, (0, size - count), value=_BASE)
        if self.device.type == "cuda":
            moved, share = self._replay(windows, rows)
        else:
            moved, share = self._compute(windows.to(self.device), rows.to(self.device))
        return moved[:count].cpu(), share[:count].cpu()

    def _compute(self, windows: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Give displacements from the last pose (metres) and shares; never waits for the device."""
        encoded = self._net.encode(windows)
        gate = {name: one[rows] for name, one in self._slab.gate.items()}
        apart = _measure(gate, encoded.z)
        share = _weigh(gate, apart)
        own = self._roll({name: one[rows] for name, one in self._slab.decoder.items()}, encoded)
        horizon = self._net.spec.horizon
        of_base = self._net.decoder(encoded.z, encoded.c, encoded.seed, horizon=horizon)
        correction = {name: one[rows] for name, one in self._slab.correction.items()}
        own = _correct(correction, own, of_base, apart)
        part = share[:, None, None, None]
        mixed = torch.where(part == 0, of_base, torch.lerp(of_base, own, part))
        frames = self._net.normalizer.from_net(mixed, windows, encoded.placement)
        return frames - windows[:, -1:], share

    def _roll(self, weights: dict[str, Tensor], encoded: Encoded) -> Tensor:
        """Roll out everybody's own decoder: row i of each weight is of window i."""
        horizon = {"horizon": self._net.spec.horizon}

        def roll_one(own: dict[str, Tensor], z: Tensor, c: Tensor, seed: Tensor) -> Tensor:
            given = (z[None], c[None], seed[None])
            return cast("Tensor", functional_call(self._one, own, given, horizon)[0])

        return torch.vmap(roll_one)(weights, encoded.z, encoded.c, encoded.seed)

    def _replay(self, windows: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Replay what `_compute` did once for this number of windows."""
        graph = self._slab.graphs.get(len(windows))
        if graph is None:
            graph = self._slab.graphs[len(windows)] = self._capture(windows, rows)
        graph.windows.copy_(windows)
        graph.rows.copy_(rows)
        graph.graph.replay()
        return graph.made

    def _capture(self, windows: Tensor, rows: Tensor) -> _Graph:
        """Capture a forecast, after the libraries have set themselves up on a stream beside."""
        given, whose = windows.to(self.device), rows.to(self.device)
        beside = torch.cuda.Stream(self.device)
        beside.wait_stream(torch.cuda.current_stream(self.device))
        with torch.cuda.stream(beside):
            for _ in range(3):
                self._compute(given, whose)
        torch.cuda.current_stream(self.device).wait_stream(beside)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            made = self._compute(given, whose)
        return _Graph(given, whose, made, graph)

    def _grow(self) -> None:
        """Give room to twice as many; graphs point to the old places and are captured again."""
        old, self._slab = self._slab, self._allocate(2 * len(self._slab))
        new = self._slab
        pairs = ((old.decoder, new.decoder), (old.gate, new.gate), (old.correction, new.correction))
        for before, now in pairs:
            for name, tensor in before.items():
                now[name][: len(old)] = tensor
        self._free.extend(range(len(self._slab) - 1, len(old) - 1, -1))

    def _allocate(self, count: int) -> _Slab:
        size = self._net.config.continuous
        shapes = {
            "mean": (size,),
            "axes": (size, DIRECTIONS),
            "points": (MOST_POINTS, DIRECTIONS),
            "directions": (),
            "half": (),
            "width": (),
            "most": (),
        }
        gate = {name: torch.zeros(count, *one, device=self.device) for name, one in shapes.items()}
        gate["width"][_BASE] = gate["directions"][_BASE] = 1.0  # so that nothing is divided by 0
        parameters = self._net.decoder.named_parameters()
        decoder = {name: one.new_zeros(count, *one.shape) for name, one in parameters}
        coordinates = 3 * self._net.spec.horizon * self._net.spec.joints
        wanted = {
            "coefficients": (MOST_POINTS, RANK),
            "basis": (RANK, coordinates),
            "width": (),
            "part": (),
        }
        correction = {
            name: torch.zeros(count, *one, device=self.device) for name, one in wanted.items()
        }
        correction["width"][_BASE] = 1.0  # so that nothing is divided by 0
        return _Slab(decoder, gate, correction)


def find_stack(base: object, device: str | None) -> Stack | None:
    """Give a base in the memory of a device, copied once; None without one, or for another kind."""
    if device is None or not isinstance(base, Predictor):
        return None
    with _stacking:
        known = _stacks.setdefault(base, {})
        if device not in known:
            known[device] = Stack(base, device)
        return known[device]


def find_device(wanted: str) -> str | None:
    """Tell where decoders are to be stacked, None where the kernel on the processor serves.

    Args:
        wanted: `auto`: a GPU where torch finds one; `cpu`: the kernel; else a device of torch.

    Raises:
        ValueError: torch has no such device.
    """
    if wanted == "cpu":
        return None
    if wanted == "auto":
        return "cuda" if torch.cuda.is_available() else None
    try:
        torch.zeros(1, device=wanted)
    except (RuntimeError, AssertionError) as error:  # a build without CUDA asserts
        reason = str(error).partition("\n")[0]
        raise ValueError(f"torch cannot compute on {wanted!r}: {reason}") from error
    return wanted


class _OpenCell(nn.GRUCell):
    """The GRU cell as plain products: torch's fused one is computed row by row under vmap."""

    def forward(self, input: Tensor, hx: Tensor | None = None) -> Tensor:  # noqa: A002 (torch's)
        """Give the next state (Cho et al. 2014, in cuDNN's form)."""
        hidden = input.new_zeros(len(input), self.hidden_size) if hx is None else hx
        given = functional.linear(input, self.weight_ih, self.bias_ih).chunk(3, dim=-1)
        kept = functional.linear(hidden, self.weight_hh, self.bias_hh).chunk(3, dim=-1)
        reset, update = torch.sigmoid(given[0] + kept[0]), torch.sigmoid(given[1] + kept[1])
        new = torch.tanh(given[2] + reset * kept[2])
        return new + update * (hidden - new)


def _open_up(decoder: Decoder) -> Decoder:
    """Give a decoder of the same weights' names that vmap can batch."""
    opened = copy.deepcopy(decoder)
    opened.cell.__class__ = _OpenCell
    return opened


def _write(slab: dict[str, Tensor], row: int, given: dict[str, Tensor]) -> None:
    for name, rows in slab.items():
        rows[row].copy_(given[name])


def _lay_out_gate(personal: PersonalDecoder) -> dict[str, Tensor]:
    """Give a gate as tensors of fixed sizes; without one, everything is familiar."""
    gate = personal.familiarity
    size = personal.base.config.continuous
    mean, axes = torch.zeros(size), torch.zeros(size, DIRECTIONS)
    points = torch.full((MOST_POINTS, DIRECTIONS), _FAR)
    half, width, directions, most = 0.0, 1.0, 1, 1.0
    if gate is None:
        half, points = 1e3, torch.zeros_like(points)
    else:
        directions = gate.points.shape[1]
        mean, axes[:, :directions] = gate.mean, gate.axes
        points[: len(gate.points), directions:] = 0
        points[: len(gate.points), :directions] = gate.points
        half, width = gate.rule.half, gate.rule.width
    numbers = {"half": half, "width": width, "directions": float(directions), "most": most}
    tensors = {name: torch.tensor(number) for name, number in numbers.items()}
    return {"mean": mean, "axes": axes, "points": points, **tensors}


def _lay_out_correction(personal: PersonalDecoder) -> dict[str, Tensor]:
    """Give a correction as tensors of fixed sizes; without one, it has no part."""
    spec, correction = personal.base.spec, personal.correction
    coefficients = torch.zeros(MOST_POINTS, RANK)
    basis = torch.zeros(RANK, 3 * spec.horizon * spec.joints)
    width, part = 1.0, 0.0
    if correction is not None:
        points, rank = correction.coefficients.shape
        coefficients[:points, :rank], basis[:rank] = correction.coefficients, correction.basis
        width, part = correction.width, correction.part
    numbers = {"width": torch.tensor(width), "part": torch.tensor(part)}
    return {"coefficients": coefficients, "basis": basis, **numbers}


def _measure(gate: dict[str, Tensor], z: Tensor) -> Tensor:
    """Give each row's squared distances to the points of its gate; see `Familiarity.measure`."""
    along = torch.einsum("bz,bzd->bd", z - gate["mean"], gate["axes"])
    apart = (along[:, None] - gate["points"]).square().sum(dim=-1)
    return apart / gate["directions"][:, None]


def _correct(correction: dict[str, Tensor], own: Tensor, of_base: Tensor, apart: Tensor) -> Tensor:
    """Give each row's corrected base its part; see `PersonalDecoder.correct`."""
    near = torch.exp(apart / (-2 * correction["width"][:, None] ** 2))
    amounts = torch.einsum("bp,bpr->br", near, correction["coefficients"])
    added = torch.einsum("br,brc->bc", amounts, correction["basis"]).view_as(own)
    return torch.lerp(own, of_base + added, correction["part"][:, None, None, None])


def _weigh(gate: dict[str, Tensor], apart: Tensor) -> Tensor:
    """Give each row's share by its own gate; see `familiarity.Familiarity.share`."""
    distance = apart.amin(dim=-1).sqrt()
    share = torch.sigmoid((gate["half"] - distance) / gate["width"])
    return ((share - SNAP) / (1 - 2 * SNAP)).clamp(0, 1) * gate["most"]
