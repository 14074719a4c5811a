"""One direction for all joints: agreement decides, and where it cannot, the clouds do."""

from dataclasses import replace

import pytest
import torch
from articulated_objects import GLASSES, clouds, true_shape

from articulate_ssl.discovery.options import DiscoveryOptions
from articulate_ssl.discovery.parallel_axes import with_parallel_axes
from articulate_ssl.discovery.registered_shape import RegisteredShape
from articulate_ssl.geometry.kinematic_chain import KinematicChain
from articulate_ssl.geometry.screw import REVOLUTE
from articulate_ssl.shape.articulated_shape import ArticulatedShape
from articulate_ssl.shape.joints import Joints

OPTIONS = DiscoveryOptions(cycles=4)


def _glasses():
    data = clouds(GLASSES, count=8, points=256)
    shape, count = true_shape(GLASSES, data), len(data.base)
    stretch = torch.zeros(count, shape.num_parts, 3)
    return data.points, RegisteredShape(shape, data.base, data.state, stretch, torch.zeros(count))


def _posed(found: RegisteredShape) -> torch.Tensor:
    return found.shape.posed(found.base, found.state)


def test_axes_that_are_parallel_stay():
    points, found = _glasses()
    torch.testing.assert_close(_posed(with_parallel_axes(found, points, OPTIONS)), _posed(found), atol=1e-4, rtol=0)


def test_the_axis_that_most_agree_with_is_taken():
    """Three parallel joints, one of whose axes was found wrong: the other two decide, whichever way they point."""
    points, found = _glasses()
    joints = found.shape.joints
    wrong = torch.nn.functional.normalize(torch.tensor([0.5, 0.6, 0.6]), dim=-1)
    axis = torch.stack([wrong, joints.axis[0], -joints.axis[0]])
    chain = KinematicChain(4, 0, (0, 0, 0), (1, 2, 3))
    label = found.shape.label.clone()
    label[::7] = 3
    lines = Joints(chain, axis, torch.cat([joints.pivot, joints.pivot[:1]]), REVOLUTE)
    state, stretch = torch.zeros(len(found.base), 3), torch.zeros(len(found.base), 4, 3)
    shape = ArticulatedShape(found.shape.points, label, lines)
    fixed = with_parallel_axes(RegisteredShape(shape, found.base, state, stretch, found.error), points, OPTIONS)
    cosine = fixed.shape.joints.axis @ joints.axis[0]
    assert cosine[1:].tolist() == [1.0, -1.0] and abs(abs(float(cosine[0])) - 1) < 1e-6
    torch.testing.assert_close(fixed.state, state)


@pytest.mark.parametrize("off", [0, 1])
def test_of_two_axes_the_clouds_choose(off):
    """Two joints agree with each other as much as each of them does; whichever was found 20 degrees off is given up."""
    points, found = _glasses()
    joints = found.shape.joints
    axis = joints.axis.clone()
    axis[off] = torch.nn.functional.normalize(axis[off] + torch.tensor([0.0, 0.36, 0.0]), dim=-1)
    tilted = replace(found, shape=replace(found.shape, joints=replace(joints, axis=axis)))
    fixed = with_parallel_axes(tilted, points, OPTIONS).shape.joints.axis
    torch.testing.assert_close(fixed, joints.axis)
