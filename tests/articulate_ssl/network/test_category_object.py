"""Where a category's parts start."""

import pytest
import torch

from articulate_ssl.geometry.rotation_group import rotation_group
from articulate_ssl.geometry.screw import REVOLUTE
from articulate_ssl.geometry.se3 import transform_points
from articulate_ssl.network.articulated_network import ArticulatedNetwork
from articulate_ssl.network.category_object import CategoryObject
from articulate_ssl.network.heads.pose import PoseHead, state_anchors
from articulate_ssl.network.options import NetworkOptions


@pytest.mark.parametrize("parts", [2, 3, 4])
def test_parts_that_start_apart_move_one_against_another(parts):
    category = CategoryObject(parts, 64)
    category.start_apart()
    centers = category.canonical().shape.mean(dim=1)
    assert torch.pdist(centers).min() > 0.08  # of the object's diagonal; the mean of 64 points is within .03 of theirs
    assert (category.axis[:, 2] > 0.8).all()
    between = category.assembly[category.pairs].mean(dim=1)
    torch.testing.assert_close(category.pivot.detach(), between.detach())


def test_joint_states_start_in_the_middles_of_equal_stretches():
    assert state_anchors(0, 2, 1.6).tolist() == [[0.0, 0.0]]
    torch.testing.assert_close(state_anchors(1, 1, 1.6), torch.tensor([[0.8]]))
    torch.testing.assert_close(state_anchors(2, 1, 1.6), torch.tensor([[0.4], [1.2]]))
    torch.testing.assert_close(state_anchors(2, 2, 1.6), torch.tensor([[0.4, 0.4], [0.4, 1.2], [1.2, 0.4], [1.2, 1.2]]))


def test_every_rotation_is_tried_with_every_start():
    options = NetworkOptions(group_order=12, head_dim=4, state_anchors=2)
    head = PoseHead(2, rotation_group(12), 1.6, options)
    network = ArticulatedNetwork(_small(state_anchors=2), 2, REVOLUTE, state_bound=1.6)
    out = network(torch.rand(2, 32, 3))
    assert out.base.shape == (2, 24, 4, 4) and out.axis.shape == (2, 24, 1, 3)
    torch.testing.assert_close(out.state[0, :4, 0], torch.tensor([0.4, 1.2, 0.4, 1.2]), atol=0.02, rtol=0)
    # Starts of one group element share its rotation until the heads have learnt something.
    torch.testing.assert_close(out.base[:, 0::2, :3, :3], out.base[:, 1::2, :3, :3], atol=0.05, rtol=0)
    residual = head.joint_state(torch.zeros(1, 2, 12, 8), network.category.chain(), residual=True)
    assert residual.abs().max() < 0.02


def _small(**options) -> NetworkOptions:
    sizes = {"group_order": 12, "dims": [4, 4, 8], "radii": [0.2, 0.3, 0.4], "num_neighbors": 8}
    return NetworkOptions(**sizes, num_kernel_points=13, head_dim=8, shape_points=16, **options)


def test_instances_have_the_categorys_shape_until_they_are_freed():
    network = ArticulatedNetwork(_small(), 2)
    for head in network.shape_head.perceptron:
        torch.nn.init.normal_(head[-1].weight)
    cloud = torch.rand(2, 32, 3)
    common = network.category.canonical().shape
    assert (network(cloud).object_shape() - common).abs().max() > 0.01
    network.shape_head.freedom = 0.0
    torch.testing.assert_close(network(cloud).object_shape(), common.expand(2, -1, -1, -1))


@pytest.mark.parametrize(("count", "stretch"), [(1, 1.6), (4, 0.4)])
def test_a_start_reaches_to_the_middle_of_its_neighbours_stretch(count, stretch):
    """However strongly the head pulls."""
    torch.manual_seed(0)
    head = PoseHead(2, rotation_group(12), 1.6, NetworkOptions(head_dim=4, state_anchors=count))
    chain = CategoryObject(2, 8).chain()
    for one in head.state:
        torch.nn.init.normal_(one[-1].weight, std=100.0)
    state = head.joint_state(torch.randn(3, 2, 12, 8), chain).unflatten(1, (12, count))[..., 0]
    away = state - state_anchors(count, 1, 1.6)[:, 0]
    assert away.abs().amax() <= stretch + 1e-6
    assert away.amax() > 0.9 * stretch and away.amin() < -0.9 * stretch


def test_lines_that_move_leave_parts_where_they_are():
    """At the states that are given; at others they turn about the new lines."""
    category = CategoryObject(4, 16)
    category.start_apart()
    category.mean_confidence.copy_(torch.tensor([1.0 if b == a + 1 else 0.0 for a, b in category.pairs.tolist()]))
    state, shift = torch.tensor([0.5, -0.8, 0.3]), 0.1 * torch.randn(3, 3, generator=torch.Generator().manual_seed(0))
    before, base = category.articulated_shape(REVOLUTE), torch.eye(4)[None]
    chain = before.joints.chain
    assert any(parent != chain.root for parent in chain.parent)  # lines move with the parts that they are on
    category.move_lines(shift, state)
    after = category.articulated_shape(REVOLUTE)
    torch.testing.assert_close(after.posed(base, state[None]), before.posed(base, state[None]), atol=1e-5, rtol=0)
    assert not torch.allclose(after.posed(base, 0 * state[None]), before.posed(base, 0 * state[None]), atol=1e-2)
    old, new = (one.joints.part_pose(base, state[None])[0, list(chain.parent)] for one in (before, after))
    moved = [transform_points(pose, one.joints.pivot[:, None])[:, 0] for pose, one in ((old, before), (new, after))]
    by = (old[:, :3, :3] @ shift[..., None]).squeeze(-1)
    torch.testing.assert_close(moved[1] - moved[0], by, atol=1e-5, rtol=0)


@pytest.mark.parametrize("shared", [True, False])
def test_the_categorys_joints_have_the_direction_that_networks_read(shared):
    """One for all where they share it, whatever became of those that nothing reads."""
    torch.manual_seed(0)
    network = ArticulatedNetwork(_small(shared_axis=shared), num_parts=4)
    for head in network.axis_head.perceptron:
        torch.nn.init.zeros_(head[-1].weight)  # instances tilt no axis
    read = network(torch.rand(1, 32, 3)).axis[0, 0]
    shape = network.category.articulated_shape(REVOLUTE)
    torch.testing.assert_close(shape.joints.axis, read.detach())
    base, state = torch.eye(4).expand(1, 1, 4, 4), torch.zeros(1, 1, 3)
    torch.testing.assert_close(network.category_at(base, state).axis[0, 0], read)
    assert (read.std(dim=0).max() < 1e-6) == shared
