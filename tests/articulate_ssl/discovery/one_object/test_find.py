"""One object from clouds of it alone."""

from itertools import permutations

import pytest
import torch
from articulated_objects import DRAWER, OVEN, clouds
from twin_objects import with_little_effort

from articulate_ssl.discovery.discover import DiscoveryError
from articulate_ssl.discovery.one_object import find
from articulate_ssl.discovery.one_object.adjustment import Placed
from articulate_ssl.discovery.one_object.find import MIN_CLOUDS, find_one_object, rooted_at
from articulate_ssl.geometry.kinematic_chain import KinematicChain
from articulate_ssl.geometry.screw import PRISMATIC, REVOLUTE
from articulate_ssl.geometry.se3 import se3
from articulate_ssl.shape.joints import Joints


@pytest.fixture(autouse=True)
def little_effort(monkeypatch):
    """These objects are simple."""
    with_little_effort(monkeypatch)


def _mean_iou(found: torch.Tensor, true: torch.Tensor, num_parts: int) -> float:
    def iou(order: tuple[int, ...]) -> float:
        same = [(found == order[k], true == k) for k in range(num_parts)]
        return sum(float((a & b).sum() / (a | b).sum()) for a, b in same) / num_parts

    return max(map(iou, permutations(range(num_parts))))


@pytest.mark.parametrize(("design", "least"), [(OVEN, 0.92), (DRAWER, 0.9)], ids=["oven", "drawer"])
def test_parts_states_and_joints_are_exact(design, least):
    data = clouds(design, count=8, points=2048, resample=True, seed=1)
    found = find_one_object(data.points, 2, design[4], part_points=256)
    assert _mean_iou(found.label, data.part.expand_as(found.label), 2) > least
    assert torch.corrcoef(torch.stack([found.state[:, 0], data.state[:, 0].double()]))[0, 1].abs() > 0.999
    joints = found.shape.joints
    root = joints.part_pose(found.base, found.state)[:, joints.chain.root, :3, :3]
    axis, truth = root @ joints.axis[0], data.base[:, :3, :3].double() @ data.axis[0].double()
    assert (axis * truth).sum(dim=-1).abs().clamp(max=1).acos().rad2deg().max() < 1.5
    assert joints.limits.tolist() == [[found.state.min().item(), found.state.max().item()]]
    assert torch.bincount(found.shape.label).tolist() == [256, 256]
    assert found.unexplained < find._EXPLAINED


def test_too_few_clouds_are_refused():
    data = clouds(OVEN, count=MIN_CLOUDS - 1, points=64)
    with pytest.raises(DiscoveryError, match="7 clouds of one object, at least 8"):
        find_one_object(data.points, 2, OVEN[4])


def test_an_object_that_does_not_move_is_refused():
    data = clouds(OVEN, count=8, points=128, resample=True)
    still = data.points[:1].repeat(8, 1, 1)
    with pytest.raises(DiscoveryError, match="parts"):
        find_one_object(still, 2, OVEN[4])


@pytest.mark.parametrize(("num_parts", "joint_type"), [(2, REVOLUTE), (2, PRISMATIC), (4, PRISMATIC)])
@pytest.mark.parametrize("root", [0, 1])
def test_another_base_moves_no_part_otherwise(num_parts, joint_type, root):
    generator = torch.Generator().manual_seed(0)
    chain = KinematicChain(num_parts, 0, (0,) * (num_parts - 1), tuple(range(1, num_parts)))
    axis = torch.tensor([[0.6, 0.0, 0.8]], dtype=torch.float64).repeat(num_parts - 1, 1)
    axis[-1] *= -1  # a joint that is described the other way round
    pivot = torch.randn(num_parts - 1, 3, generator=generator, dtype=torch.float64)
    state = torch.randn(5, num_parts - 1, generator=generator, dtype=torch.float64)
    base = se3(torch.eye(3).expand(5, 3, 3), torch.randn(5, 3, generator=generator)).double()
    placed = Placed(Joints(chain, axis, pivot, joint_type), base, state)
    moved = rooted_at(placed, root)
    assert moved.joints.chain.root == root
    # At rest parts may stand elsewhere; from any state to any other they move alike.
    before, after = (p.pose[1:] @ torch.linalg.inv(p.pose[:1]) for p in (placed, moved))
    torch.testing.assert_close(after, before)
