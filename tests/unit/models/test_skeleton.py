import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from models.data.synthetic import SyntheticPerson
from models.skeleton import (
    FOOT_REACH,
    HAND_REACH,
    KINECT_V1,
    NET_JOINTS,
    SKELETONS,
    Skeleton,
    from_y_up,
    to_y_up,
    topological_levels,
)

TABLE = Path(__file__).resolve().parents[4] / "shared" / "skeletons.json"
TABLE_NAMES = {
    "kinect_v1": ("k1_utd", None),
    "kinect_v1_sdk": ("k1_sdk", "SDK"),
    "kinect_v2": ("k2", "K2"),
    "azure_kinect": ("azure", "AK"),
    "mediapipe": ("mediapipe", "MP"),
    "coco17": ("coco17", "COCO"),
    "body25": ("body25", "B25"),
    "h36m17": ("h36m17", "H36"),
    "smpl24": ("smpl24", "SMPL"),
}
ALL = pytest.mark.parametrize("skeleton", SKELETONS.values(), ids=SKELETONS.keys())


@ALL
def test_every_format_is_complete(skeleton: Skeleton) -> None:
    joints = len(skeleton.joints)
    assert len(set(skeleton.joints)) == joints
    assert len(skeleton.parents) in {0, joints}
    assert len(skeleton.mirror) == len(skeleton.forecast) == joints
    assert skeleton.to_net.shape == (NET_JOINTS, joints)
    assert skeleton.carry.shape == (joints,)
    assert set(skeleton.carry.tolist()) <= set(range(NET_JOINTS))
    assert {end for bone in skeleton.bones for end in bone} <= set(range(joints))


@pytest.mark.parametrize(
    "skeleton", [s for s in SKELETONS.values() if s.parents], ids=lambda s: s.name
)
def test_trees_have_one_root_and_a_bone_to_every_other_joint(skeleton: Skeleton) -> None:
    assert sum(map(len, topological_levels(skeleton.parents))) == len(skeleton.joints)
    assert len(skeleton.bones) == len(skeleton.joints) - 1


@ALL
def test_mirroring_twice_changes_nothing_and_swaps_what_has_a_side(skeleton: Skeleton) -> None:
    mirror = np.array(skeleton.mirror)
    assert np.array_equal(mirror[mirror], np.arange(len(mirror)))
    carried = np.array(KINECT_V1.mirror)[skeleton.carry]
    assert np.array_equal(skeleton.carry[mirror], carried)
    net_mirror = np.array(KINECT_V1.mirror)
    assert np.allclose(skeleton.to_net[net_mirror][:, mirror], skeleton.to_net)


@ALL
def test_the_map_moves_with_the_body(skeleton: Skeleton) -> None:
    assert np.allclose(skeleton.to_net.sum(axis=1), 1.0, atol=1e-12)


@ALL
def test_joints_forecast_by_the_net_are_exactly_its_own(skeleton: Skeleton) -> None:
    for joint, kind in enumerate(skeleton.forecast):
        row = skeleton.to_net[skeleton.carry[joint]]
        alone = row[joint] == 1.0 and np.count_nonzero(row) == 1
        assert (kind == "net") == alone


@ALL
def test_carried_joints_stay_in_their_half_of_the_body(skeleton: Skeleton) -> None:
    for joint, net in zip(skeleton.joints, skeleton.carry, strict=True):
        name = KINECT_V1.joints[net]
        if "hand" in joint.lower() or "thumb" in joint.lower():
            assert name.endswith("hand")
        if "heel" in joint.lower():
            assert name.endswith("ankle")
        if any(part in joint.lower() for part in ("eye", "ear", "nose", "mouth")):
            assert name == "head"


@ALL
def test_arrays_cannot_be_changed_by_accident(skeleton: Skeleton) -> None:
    with pytest.raises(ValueError, match="read-only"):
        skeleton.to_net[0, 0] = 2.0


@pytest.mark.parametrize("known", TABLE_NAMES)
def test_formats_equal_the_checked_table(known: str) -> None:
    if not TABLE.exists():
        pytest.skip(f"no table at {TABLE}")
    table = json.loads(TABLE.read_text())
    skeleton, (name, rules) = SKELETONS[known], TABLE_NAMES[known]
    assert list(skeleton.joints) == table[name]["joints"]
    assert list(skeleton.parents) == (table[name]["parents"] or [])
    for row, rule in zip(skeleton.to_net, table["to_k1"].get(rules, []), strict=False):
        sources = [rule] if isinstance(rule, int) else rule
        if isinstance(sources, list):
            assert np.allclose(row, np.eye(len(row))[sources].mean(0))


def test_the_nets_own_format_is_left_as_it_is() -> None:
    assert np.array_equal(KINECT_V1.to_net, np.eye(NET_JOINTS))
    assert np.array_equal(KINECT_V1.carry, np.arange(NET_JOINTS))
    assert set(KINECT_V1.forecast) == {"net"}


def test_the_sdk_order_is_a_permutation_that_undoes_itself() -> None:
    sdk = SKELETONS["kinect_v1_sdk"].to_net
    assert np.array_equal(sdk @ sdk, np.eye(NET_JOINTS))
    assert sdk[3, 0] == 1.0


def test_missing_joints_are_estimated_from_the_limb() -> None:
    coco = SKELETONS["coco17"]
    pose = np.random.default_rng(0).normal(size=(17, 3))
    net = coco.to_net @ pose
    elbow, wrist, knee, ankle = pose[7], pose[9], pose[13], pose[15]
    assert np.allclose(net[7], wrist + HAND_REACH * (wrist - elbow))
    assert np.allclose(net[15], ankle + FOOT_REACH * (ankle - knee))
    hips, shoulders = (pose[11] + pose[12]) / 2, (pose[5] + pose[6]) / 2
    assert np.allclose(net[3], hips + 0.19 * (shoulders - hips))


def test_centre_joints_of_other_formats_land_near_the_real_ones() -> None:
    pose = SyntheticPerson(0).record("stand", 0.1)[0].astype(np.float64)
    coco = np.zeros((17, 3))
    for joint, net in enumerate(SKELETONS["coco17"].carry):
        coco[joint] = pose[net]
    error = np.linalg.norm(SKELETONS["coco17"].to_net @ coco - pose, axis=1)
    assert error.max() < 0.1


def test_the_layout_is_the_hash_of_the_names() -> None:
    names = "\n".join(KINECT_V1.joints).encode()
    assert KINECT_V1.layout_sha256 == hashlib.sha256(names).hexdigest()
    assert len({skeleton.layout_sha256 for skeleton in SKELETONS.values()}) == len(SKELETONS)


@pytest.mark.parametrize("up", ["y", "-y", "z"])
def test_turning_the_axes_is_a_rotation_and_can_be_undone(up: str) -> None:
    matrix = to_y_up(np.eye(3), up)
    assert np.linalg.det(matrix) == pytest.approx(1.0)
    points = np.random.default_rng(1).normal(size=(4, 20, 3)).astype(np.float32)
    turned = to_y_up(points, up)
    assert turned.dtype == np.float32
    assert np.array_equal(from_y_up(turned, up), points)


@pytest.mark.parametrize(("up", "above"), [("y", (0, 1, 0)), ("-y", (0, -1, 0)), ("z", (0, 0, 1))])
def test_up_becomes_y(up: str, above: tuple[int, int, int]) -> None:
    assert to_y_up(np.array(above, dtype=np.float64), up).tolist() == [0, 1, 0]


def test_an_unknown_up_axis_is_refused() -> None:
    with pytest.raises(ValueError, match="up must be one of y, -y, z"):
        to_y_up(np.zeros(3), "x")


@pytest.mark.parametrize("parents", [(), (-1, -1), (1, 0), (-1, 2, 1)])
def test_what_is_not_one_tree_is_refused(parents: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="not one tree"):
        topological_levels(parents)


def test_levels_put_parents_first() -> None:
    levels = topological_levels(KINECT_V1.parents)
    depth = {joint: level for level, joints in enumerate(levels) for joint in joints}
    assert levels[0] == (3,)
    assert all(depth[j] == depth[p] + 1 for j, p in enumerate(KINECT_V1.parents) if p >= 0)
