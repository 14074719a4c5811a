"""BSP-Net: a box made of planes by hand is one, both phases learn, and a point is in the convex it lies deepest in."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from occupied import write_occupied_set
from torch.testing import assert_close

from articulate_ssl.baselines import bsp_net, method_class
from articulate_ssl.baselines.bsp_net import CONVEXES, PLANES, UNION_WEIGHT, BSPNet, leaky_clip
from articulate_ssl.baselines.implicit import COORDINATES
from articulate_ssl.baselines.method import Problem
from articulate_ssl.geometry.screw import REVOLUTE
from datamodules.articulated_data_module import ArticulatedDataModule

PROBLEM = Problem(num_parts=2, joint_type=REVOLUTE, state_range=1.3, num_points=32)
LOW, HIGH = torch.tensor([-0.4, -0.1, -0.1]), torch.tensor([0.4, 0.1, 0.1])


@pytest.fixture
def boxes():
    """A network whose every shape is two boxes: convex 0 has x in [-0.4, 0.1], convex 3 has x in [-0.1, 0.4]."""
    torch.manual_seed(0)
    method = BSPNet(PROBLEM)
    last = method.planes[-1]
    plane = torch.zeros(4, PLANES)
    connection = torch.zeros(PLANES, CONVEXES)
    for convex, (low, high) in {0: (-0.4, 0.1), 3: (-0.1, 0.4)}.items():
        bounds = [(0, -1, low), (0, 1, -high)] + [(axis, sign, -0.1) for axis in (1, 2) for sign in (-1, 1)]
        for i, (axis, sign, offset) in enumerate(bounds):
            own = 10 * convex + i
            plane[axis, own], plane[3, own] = sign, COORDINATES * offset
            connection[own, convex] = 1.0
    with torch.no_grad():
        last.weight.zero_()
        last.bias.copy_(plane.flatten())
        method.connection.copy_(connection)
        method.union.fill_(1.0)
    return method


def grid() -> torch.Tensor:
    """Points in and around the boxes, none on a face."""
    torch.manual_seed(1)
    return torch.rand(1, 2000, 3) * 1.2 - 0.6


def inside_union(points: torch.Tensor) -> torch.Tensor:
    return ((points > LOW) & (points < HIGH)).all(-1)


def test_the_union_of_convexes_is_the_shape(boxes):
    points = grid()
    inside = inside_union(points)
    distance = boxes.plane_distances(points, points).relu()
    assert torch.equal(boxes._outside(distance).amin(-1) == 0, inside)
    assert inside.any() and not inside.all()
    outside = points[:, ~inside[0]]
    assert (boxes._outside(boxes.plane_distances(points, outside).relu()).amin(-1) > 0).all()


def test_losses_of_a_perfect_shape(boxes):
    """With steep planes the losses of the true occupancy vanish; those of its opposite do not."""
    points = grid()
    occupancy = inside_union(points).float()
    distance = 1e4 * boxes.plane_distances(points, points).relu()
    with torch.no_grad():
        boxes.union.zero_()[[0, 3]] = 1.0  # those without planes are everywhere, unless W leaves them out
    weights = UNION_WEIGHT * (CONVEXES - 2)  # L_W of those left out
    assert_close(boxes.continuous_loss(distance, occupancy), torch.tensor(weights), atol=1e-2, rtol=0)
    assert boxes.continuous_loss(distance, 1 - occupancy) > weights + 0.9
    assert boxes.discrete_loss(distance, occupancy) < 1e-3
    assert boxes.discrete_loss(distance, 1 - occupancy) > 0.9
    with torch.no_grad():
        boxes.connection[5, 7], boxes.connection[6, 7] = -0.5, 1.25
    penalty = boxes.continuous_loss(distance, occupancy) - weights
    assert_close(penalty, torch.tensor(0.75), atol=2e-2, rtol=0)


def test_a_full_clip_leaks():
    values = torch.tensor([-3.0, 0.25, 5.0], requires_grad=True)
    clipped = leaky_clip(values)
    assert_close(clipped.detach(), torch.tensor([-0.03, 0.25, 1.04]))
    clipped.sum().backward()
    assert_close(values.grad, torch.tensor([0.01, 1.0, 0.01]))


def test_a_point_belongs_to_the_convex_it_lies_deepest_in(boxes):
    points = torch.tensor([[[-0.3, 0, 0], [0.3, 0, 0], [-0.05, 0, 0], [0.05, 0, 0], [-0.9, 0, 0], [0.9, 0.3, 0]]])
    assert boxes.primitive_of(points)[0].tolist() == [0, 3, 0, 3, 0, 3]


def test_a_convex_without_planes_is_nowhere(boxes):
    assert boxes.primitive_of(10 * grid()).unique().tolist() == [0, 3]


@pytest.mark.parametrize("discrete", [False, True])
def test_both_phases_learn(tmp_path, discrete):
    folder = write_occupied_set(tmp_path)
    data = ArticulatedDataModule("laptop", str(folder.parents[1]), num_points=32, batch_size=4, occupancy=True)
    data.setup("fit")
    torch.manual_seed(0)
    method = BSPNet(PROBLEM)
    if discrete:  # without a trainer the step is 0
        method.effort = replace(method.effort, steps=0)
    before = method.connection.detach().clone()
    optimizer = method.configure_optimizers()["optimizer"]
    batch, losses = next(iter(data.train_dataloader())), []
    for step in range(40):
        loss = method.training_step(batch, step)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.9 * losses[0]
    assert torch.equal(before, method.connection) == discrete, "the second phase keeps T"


def test_it_is_a_row_of_the_table_and_not_of_partial_views():
    assert method_class("bsp_net") is BSPNet and BSPNet.views == ("complete",)
    assert 0 < bsp_net.CONTINUOUS_SHARE < 1
