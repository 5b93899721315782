"""The Structured Prediction Layer: one small MLP per joint along the kinematic tree.

Aksan, Kaufmann, Hilliges 2019. Each joint's MLP sees the decoder's state and what was predicted for
all of its ancestors, so that a hand can follow from its arm. Joints of the same depth are evaluated
together as one batched product; the part of the first layer that reads the decoder's state is the
same product for all joints.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

from models.skeleton import topological_levels


class StructuredPrediction(nn.Module):
    """Predict three coordinates per joint, parents first.

    Args:
        parents: index of each joint's parent, -1 for the root.
        features: numbers in the decoder's state.
        hidden: width of each joint's single hidden layer.
    """

    def __init__(self, parents: tuple[int, ...], *, features: int, hidden: int) -> None:
        super().__init__()
        self.joints = len(parents)
        self.hidden = hidden
        levels = topological_levels(parents)
        order = [joint for level in levels for joint in level]
        self.sizes = [len(level) for level in levels]
        # For each level below the root: where each joint's parent stands in the level above.
        self.above = [
            [levels[depth - 1].index(parents[joint]) for joint in level]
            for depth, level in enumerate(levels)
            if depth
        ]
        self.from_state = nn.Linear(features, self.joints * hidden)
        self.from_ancestors = nn.ParameterList(
            [_uniform(size, 3 * depth, hidden) for depth, size in enumerate(self.sizes) if depth]
        )
        self.to_offset = nn.Parameter(torch.zeros(self.joints, hidden, 3))
        self.bias = nn.Parameter(torch.zeros(self.joints, 1, 3))
        self.back: Tensor
        self.register_buffer("back", torch.tensor(order).argsort(), persistent=False)

    def forward(self, state: Float[Tensor, "batch features"]) -> Float[Tensor, "batch joint 3"]:
        """One pose from the decoder's state (normalised units, relative to a reference pose).

        Inside, joints stand in topological order, so that a level is a slice.
        """
        first = self.from_state(state).view(len(state), self.joints, self.hidden).transpose(0, 1)
        inner = first.split(self.sizes)  # per level: joint batch hidden
        weights, biases = self.to_offset.split(self.sizes), self.bias.split(self.sizes)
        offset = torch.baddbmm(biases[0], torch.relu(inner[0]), weights[0])
        known, offsets = offset, [offset]  # what a level's children know: all of their ancestors
        for depth, above in enumerate(self.above, start=1):
            seen = torch.stack([known[parent] for parent in above])
            hidden = torch.relu(torch.baddbmm(inner[depth], seen, self.from_ancestors[depth - 1]))
            offset = torch.baddbmm(biases[depth], hidden, weights[depth])
            known = torch.cat([seen, offset], dim=-1)
            offsets.append(offset)
        return torch.cat(offsets).index_select(0, self.back).transpose(0, 1)


def _uniform(joints: int, inputs: int, outputs: int) -> nn.Parameter:
    bound = 1 / math.sqrt(inputs)
    return nn.Parameter(torch.empty(joints, inputs, outputs).uniform_(-bound, bound))
