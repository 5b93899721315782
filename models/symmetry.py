"""Nets that know that left and right are alike: mirrored people get mirrored forecasts.

Mirroring a pose is a signed permutation of its numbers (x changes its sign, left joints change
places with right ones). Let it act on every hidden layer too, by swapping the halves of its units
(for the layers of the joints: those of left and right joints), and ask of each weight that it is
the same before and after. Such weights are a linear subspace, products and pointwise functions
commute with the permutations, and so does the whole net (regular representations of a group of two;
Cohen and Welling, Group Equivariant Convolutional Networks, 2016). Shapes and arithmetic stay as
they are: a net of this kind is an ordinary net whose weights happen to be symmetric.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from models.predictor import Predictor
from models.skeleton import KINECT_V1, topological_levels

_X_FLIPPED = (-1.0, 1.0, 1.0)


@dataclass(frozen=True, eq=False)
class _Swap:
    """How mirroring acts on one axis: entry i becomes entry `take[i]`, times `sign[i]`."""

    take: Tensor
    sign: Tensor

    def __add__(self, other: "_Swap") -> "_Swap":
        """Act on an axis on which both stand one after the other."""
        take = torch.cat([self.take, other.take + len(self.take)])
        return _Swap(take, torch.cat([self.sign, other.sign]))

    def to(self, device: torch.device) -> "_Swap":
        """Act on tensors of a device."""
        return _Swap(self.take.to(device), self.sign.to(device))

    def repeat(self, times: int) -> "_Swap":
        """Act on an axis that holds the same several times over."""
        whole = self
        for _ in range(times - 1):
            whole = whole + self
        return whole

    def apply(self, values: Tensor, *, axis: int) -> Tensor:
        """Mirror one axis."""
        shape = [1] * values.ndim
        shape[axis] = -1
        return values.index_select(axis, self.take) * self.sign.view(shape)


class Symmetry:
    """How mirroring acts on every parameter of a net, which stays on the device where it is.

    Raises:
        ValueError: a size or a number of heads is odd, so that there are no halves to swap.
    """

    def __init__(self, net: Predictor) -> None:
        device = net.normalizer.mean_pose.device
        self.pose = _mirror_pose().to(device)
        self.swaps = {
            name: tuple(swap.to(device) for swap in swaps) for name, swaps in _find_swaps(net)
        }

    @torch.no_grad()
    def impose(self, net: Predictor, *, is_fresh: bool = False) -> None:
        """Replace the net's weights and mean pose by the nearest symmetric ones.

        Args:
            net: the net.
            is_fresh: random weights, which shrink when they are averaged, get their size back.
        """
        for name, weight in net.named_parameters():
            growth = 2**0.5 if is_fresh and weight.ndim > 1 else 1.0
            weight.copy_(self._average(name, weight) * growth)
        mean = net.normalizer.mean_pose
        mean.copy_((mean + self.pose.apply(mean.flatten(), axis=0).view_as(mean)) / 2)

    @torch.no_grad()
    def impose_on_gradients(self, net: Predictor) -> None:
        """Keep of the gradients what is symmetric: as if each window had come mirrored as well."""
        for name, weight in net.named_parameters():
            if weight.grad is not None:
                weight.grad.copy_(self._average(name, weight.grad))

    def _average(self, name: str, values: Tensor) -> Tensor:
        mirrored = values
        for axis, swap in enumerate(self.swaps[name]):
            mirrored = swap.apply(mirrored, axis=axis)
        return (values + mirrored) / 2


def _find_swaps(net: Predictor) -> Iterator[tuple[str, tuple[_Swap, ...]]]:
    size = net.config
    if size.encoder_heads % 2 or size.decoder_heads % 2:
        raise ValueError("attention of a symmetric net needs an even number of heads")
    pose, stream, z = _mirror_pose(), halves(size.encoder_hidden), halves(size.continuous)
    c, token, state = (
        _keep(size.categories),
        halves(size.decoder_token),
        halves(size.decoder_hidden),
    )
    for name, gru in net.encoder.streams.items():
        yield from _of_gru(f"encoder.streams.{name}", gru, pose, stream)
    yield from _of_attention("encoder.attention", stream)
    yield from _of_linear("latent.to_z", z, stream.repeat(3))
    yield from _of_linear("latent.to_c", c, stream.repeat(3))
    yield from _of_linear("decoder.token_z", token, z)
    yield from _of_linear("decoder.token_c", token, c)
    yield from _of_linear("decoder.token_h", token, state)
    yield from _of_linear("decoder.start", state, z + c)
    yield from _of_attention("decoder.attention", token)
    yield from _of_gru("decoder.cell", net.decoder.cell, pose + token.repeat(3), state)
    yield from _of_joints("decoder.predict", state, size.spl_hidden)


def _keep(count: int) -> _Swap:
    return _Swap(torch.arange(count), torch.ones(count))


def halves(count: int) -> _Swap:
    """Act on units by swapping their halves.

    Raises:
        ValueError: there are no halves.
    """
    if count % 2:
        raise ValueError(f"{count} units of a symmetric net have no halves")
    return _Swap(torch.arange(count).roll(count // 2), torch.ones(count))


def _mirror_pose() -> _Swap:
    take = torch.tensor(KINECT_V1.mirror)[:, None] * 3 + torch.arange(3)
    return _Swap(take.flatten(), torch.tensor(_X_FLIPPED).repeat(len(KINECT_V1.mirror)))


def _of_linear(name: str, out: _Swap, into: _Swap) -> Iterator[tuple[str, tuple[_Swap, ...]]]:
    yield f"{name}.weight", (out, into)
    yield f"{name}.bias", (out,)


def _of_gru(
    name: str, gru: nn.Module, into: _Swap, state: _Swap
) -> Iterator[tuple[str, tuple[_Swap, ...]]]:
    gates = state.repeat(3)
    for part, _ in gru.named_parameters():
        if part.startswith("weight"):
            yield f"{name}.{part}", (gates, into if "_ih" in part else state)
        else:
            yield f"{name}.{part}", (gates,)


def _of_attention(name: str, width: _Swap) -> Iterator[tuple[str, tuple[_Swap, ...]]]:
    yield from _of_linear(f"{name}.project", width.repeat(3), width)
    yield from _of_linear(f"{name}.mix", width, width)
    yield f"{name}.norm.weight", (width,)
    yield f"{name}.norm.bias", (width,)


def _of_joints(name: str, state: _Swap, hidden: int) -> Iterator[tuple[str, tuple[_Swap, ...]]]:
    """SPL: what is left in a side joint's layer is right in its twin's; all layers swap halves."""
    levels = topological_levels(KINECT_V1.parents)
    joints, inner = _twins([joint for level in levels for joint in level]), halves(hidden)
    point, single = _Swap(torch.arange(3), torch.tensor(_X_FLIPPED)), _keep(1)
    units = (joints.take[:, None] * hidden + inner.take).flatten()
    yield from _of_linear(f"{name}.from_state", _Swap(units, torch.ones(len(units))), state)
    for depth, level in enumerate(levels):
        if depth:
            swaps = (_twins(level), point.repeat(depth), inner)
            yield f"{name}.from_ancestors.{depth - 1}", swaps
    yield f"{name}.to_offset", (joints, inner, point)
    yield f"{name}.bias", (joints, single, point)


def _twins(joints: list[int] | tuple[int, ...]) -> _Swap:
    """Where each joint's twin of the other side stands among the same joints."""
    take = [list(joints).index(KINECT_V1.mirror[joint]) for joint in joints]
    return _Swap(torch.tensor(take), torch.ones(len(take)))
