import pytest
import torch

from models.skeleton import KINECT_V1
from models.structured_prediction import StructuredPrediction


@pytest.fixture
def layer() -> StructuredPrediction:
    torch.manual_seed(0)
    layer = StructuredPrediction(KINECT_V1.parents, features=12, hidden=6)
    torch.nn.init.normal_(layer.to_offset)
    return layer


def descendants(joint: int) -> set[int]:
    found = {joint}
    while more := {j for j, p in enumerate(KINECT_V1.parents) if p in found} - found:
        found |= more
    return found


@pytest.mark.parametrize("joint", [1, 4, 13, 19])
def test_a_joint_is_felt_by_its_descendants_alone(layer: StructuredPrediction, joint: int) -> None:
    state = torch.randn(5, 12)
    before = layer(state)
    order = layer.back.argsort().tolist()  # inside, joints stand in topological order
    with torch.no_grad():
        layer.bias[order.index(joint)] += 1.0
    moved = (layer(state) - before).abs().amax(dim=(0, 2)) > 1e-5
    assert set(moved.nonzero().squeeze(-1).tolist()) == descendants(joint)


def test_it_equals_the_joint_by_joint_recursion(layer: StructuredPrediction) -> None:
    state = torch.randn(4, 12)
    order = layer.back.argsort().tolist()
    first = layer.from_state(state).view(4, 20, 6)
    done: dict[int, torch.Tensor] = {}
    for place, joint in enumerate(order):
        chain: list[int] = []
        parent = KINECT_V1.parents[joint]
        while parent >= 0:
            chain.insert(0, parent)
            parent = KINECT_V1.parents[parent]
        hidden = first[:, place]
        if chain:
            level = [len(_chain(other)) for other in order]
            depth = len(chain)
            weight = layer.from_ancestors[depth - 1][place - level.index(depth)]
            hidden = hidden + torch.cat([done[j] for j in chain], -1) @ weight
        done[joint] = torch.relu(hidden) @ layer.to_offset[place] + layer.bias[place]
    expected = torch.stack([done[j] for j in range(20)], dim=1)
    assert torch.allclose(layer(state), expected, atol=1e-5)


def _chain(joint: int) -> list[int]:
    chain = []
    while (joint := KINECT_V1.parents[joint]) >= 0:
        chain.append(joint)
    return chain
