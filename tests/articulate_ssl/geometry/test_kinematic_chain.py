"""Kinematic chain against brute force over every spanning tree."""

import math
from itertools import combinations

import networkx as nx
import pytest
import torch
from rigid_motions import DTYPE, random_pose, unit
from torch.testing import assert_close

from articulate_ssl.geometry.kinematic_chain import (
    KinematicChain,
    edge_marginals,
    extract_chain,
    forward_kinematics,
    pair_index,
)
from articulate_ssl.geometry.screw import REVOLUTE, screw_motion
from articulate_ssl.geometry.se3 import transform_points


def _spanning_trees(num_parts: int) -> list[tuple[int, ...]]:
    """Every spanning tree as indices into `pair_index`."""
    pairs = pair_index(num_parts).tolist()
    trees = []
    for edges in combinations(range(len(pairs)), num_parts - 1):
        graph = nx.Graph([pairs[e] for e in edges])
        if len(graph) == num_parts and nx.is_connected(graph):
            trees.append(edges)
    assert len(trees) == num_parts ** (num_parts - 2)  # Cayley
    return trees


def _edges(chain: KinematicChain) -> set[tuple[int, int]]:
    return {(min(p, c), max(p, c)) for p, c in zip(chain.parent, chain.child, strict=True)}


@pytest.mark.parametrize("num_parts", [2, 3, 4, 5])
def test_the_chain_is_the_maximum_spanning_tree_rooted_at_the_part_of_largest_degree(num_parts):
    pairs = pair_index(num_parts).tolist()
    trees = _spanning_trees(num_parts)
    for confidence in torch.randn(20, len(pairs), generator=torch.Generator().manual_seed(num_parts)):
        chain = extract_chain(confidence, num_parts)
        best = max(trees, key=lambda tree: confidence[list(tree)].sum())
        assert _edges(chain) == {tuple(pairs[e]) for e in best}
        degree = [sum(part in edge for edge in _edges(chain)) for part in range(num_parts)]
        assert chain.root == degree.index(max(degree))


def test_joints_come_in_dfs_order_and_transform_from_the_leaves():
    # Edges of the tree 2-0, 0-1, 1-3, 0-4; part 0 has the largest degree.
    tree = {(0, 2), (0, 1), (1, 3), (0, 4)}
    confidence = torch.tensor([1.0 if tuple(p) in tree else 0.0 for p in pair_index(5).tolist()])
    chain = extract_chain(confidence, 5)
    assert (chain.root, chain.parent, chain.child) == (0, (0, 1, 0, 0), (1, 3, 2, 4))
    assert chain.transformation_order == (3, 2, 1, 0)
    visited = {chain.root}
    for parent, child in zip(chain.parent, chain.child, strict=True):
        assert parent in visited
        visited.add(child)


def test_a_part_moves_with_its_ancestors_from_the_leaves_to_the_root():
    chain = extract_chain(torch.tensor([1.0, 0.0, 0.0, 1.0, 0.0, 1.0]), 4)  # 0-1-2-3, rooted at 1
    generator = torch.Generator().manual_seed(0)
    axis = torch.nn.functional.normalize(torch.randn(3, 3, generator=generator, dtype=torch.float64), dim=-1)
    pivot, state = torch.randn(2, 3, 3, generator=generator, dtype=torch.float64)
    motion = screw_motion(axis, pivot, state[:, 0], REVOLUTE)
    shapes = dict(enumerate(torch.randn(4, 5, 3, generator=generator, dtype=torch.float64)))
    expected = dict(shapes)
    for joint in chain.transformation_order:  # the paper's procedure: each joint moves all that hangs on it
        hanging = {chain.child[joint]}
        for parent, child in zip(chain.parent, chain.child, strict=True):
            hanging |= {child} if parent in hanging else set()
        expected = {k: transform_points(motion[joint], v) if k in hanging else v for k, v in expected.items()}
    moved = transform_points(chain.part_motion(motion), torch.stack(list(shapes.values())))
    torch.testing.assert_close(moved, torch.stack(list(expected.values())), rtol=1e-12, atol=1e-12)
    assert torch.equal(moved[chain.root], shapes[chain.root])


@pytest.mark.parametrize("num_parts", [2, 3, 4, 5])
def test_edge_marginals_are_those_of_all_spanning_trees(num_parts):
    trees = _spanning_trees(num_parts)
    confidence = 2 * torch.randn(7, len(pair_index(num_parts)), dtype=torch.float64)
    weight = torch.stack([confidence[:, list(tree)].sum(dim=1).exp() for tree in trees], dim=1)
    present = torch.tensor([[e in tree for e in range(confidence.shape[1])] for tree in trees]).double()
    expected = weight @ present / weight.sum(dim=1, keepdim=True)
    marginals = edge_marginals(confidence, num_parts)
    torch.testing.assert_close(marginals, expected, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(marginals.sum(dim=1), torch.full((7,), num_parts - 1.0).double(), rtol=1e-9, atol=1e-9)


def test_edge_marginals_have_the_gradient_they_claim():
    confidence = torch.randn(3, 6, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda c: edge_marginals(c, 4), (confidence,))


@pytest.mark.parametrize("offset", [-1e3, 1e3])
def test_edge_marginals_do_not_depend_on_a_common_offset_and_survive_extreme_confidences(offset):
    confidence = torch.tensor([0.5, -1.0, 2.0])
    torch.testing.assert_close(
        edge_marginals(confidence + offset, 3), edge_marginals(confidence, 3), rtol=1e-3, atol=1e-3
    )
    certain = torch.tensor([100.0, -100.0, 100.0], requires_grad=True)
    marginals = edge_marginals(certain, 3)
    marginals[0].backward()
    torch.testing.assert_close(marginals, torch.tensor([1.0, 0.0, 1.0]), rtol=1e-3, atol=1e-3)
    assert certain.grad.isfinite().all()


def test_forward_kinematics_composes_from_the_root_outwards():
    # Tree 2 -> 0 -> 3 and 2 -> 1, joints listed child first.
    motion = random_pose(4, 3)
    pose = forward_kinematics(motion, parent=[0, 2, 2], child=[3, 0, 1], num_parts=4)
    assert_close(pose[:, 2], torch.eye(4, dtype=DTYPE).expand(4, 4, 4))
    assert_close(pose[:, 0], motion[:, 1])
    assert_close(pose[:, 1], motion[:, 2])
    assert_close(pose[:, 3], motion[:, 1] @ motion[:, 0])


def test_forward_kinematics_carries_a_distal_joint_line_with_its_parent():
    axis = torch.stack([unit(0, 0, 1), unit(0, 0, 1)])
    pivot = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], dtype=DTYPE)
    motion = screw_motion(axis, pivot, torch.full((2,), math.pi / 2, dtype=DTYPE), REVOLUTE)
    pose = forward_kinematics(motion, [0, 1], [1, 2], 3)
    elbow, hand = torch.tensor([[1.0, 0.0, 0.0]], dtype=DTYPE), torch.tensor([[2.0, 0.0, 0.0]], dtype=DTYPE)
    assert_close(transform_points(pose[2], elbow), torch.tensor([[0.0, 1.0, 0.0]], dtype=DTYPE))
    assert_close(transform_points(pose[2], hand), torch.tensor([[-1.0, 1.0, 0.0]], dtype=DTYPE))


def test_forward_kinematics_without_joints_leaves_parts_at_rest():
    pose = forward_kinematics(torch.empty(5, 0, 4, 4), [], [], 2)
    assert_close(pose, torch.eye(4).expand(5, 2, 4, 4))


def test_forward_kinematics_gradcheck():
    axis, pivot = unit(1, 0, 1).expand(2, 3), torch.randn(2, 3, dtype=DTYPE)

    def last_part(state: torch.Tensor) -> torch.Tensor:
        return forward_kinematics(screw_motion(axis, pivot, state, REVOLUTE), [0, 1], [1, 2], 3)[2]

    assert torch.autograd.gradcheck(last_part, torch.tensor([0.0, 0.4], dtype=DTYPE, requires_grad=True), atol=1e-4)


@pytest.mark.parametrize(
    ("parent", "child", "message"),
    [([0, 1], [2, 2], "two parents"), ([1, 0], [0, 1], "cycle"), ([0], [0], "cycle")],
)
def test_joints_that_form_no_tree_are_refused(parent, child, message):
    with pytest.raises(ValueError, match=message):
        forward_kinematics(torch.eye(4).expand(len(child), 4, 4), parent, child, 3)
