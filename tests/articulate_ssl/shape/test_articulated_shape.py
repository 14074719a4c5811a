"""The articulated shape: posed by its joints, read back, thinned."""

from dataclasses import replace

import pytest
import torch
from articulated_objects import DRAWER, GLASSES, LAPTOP, clouds, true_shape

from articulate_ssl.geometry.se3 import se3
from articulate_ssl.shape.articulated_shape import ArticulatedShape


def test_states_are_read_off_free_part_poses():
    for design in (LAPTOP, DRAWER, GLASSES):
        data = clouds(design)
        shape = true_shape(design, data)
        read = shape.read_states(shape.joints.part_pose(data.base, data.state))
        torch.testing.assert_close(read, data.state, rtol=1e-4, atol=1e-4)


def test_states_stay_within_the_limits():
    data = clouds(LAPTOP)
    shape = true_shape(LAPTOP, data)
    middle = data.state.median()
    limits = torch.stack([data.state.min(dim=0).values, middle[None]], dim=-1)
    limited = replace(shape, joints=replace(shape.joints, limits=limits))
    read = limited.read_states(shape.joints.part_pose(data.base, data.state))
    torch.testing.assert_close(read, data.state.clamp(max=middle), rtol=1e-4, atol=1e-4)


def test_a_thinned_template_keeps_every_part():
    label = torch.zeros(1000, dtype=torch.long)
    label[::50] = 1  # a plain stride of 50 would see nothing else
    label[1] = 2
    template = ArticulatedShape.unjointed(torch.rand(1000, 3), label, 3)
    thin = template.thinned(100)
    assert thin.label.bincount(minlength=3).tolist() == [98, 4, 1]
    assert template.thinned(1000) is template


def test_another_canonical_space_changes_no_cloud():
    for design in (LAPTOP, DRAWER, GLASSES):
        data = clouds(design)
        shape = true_shape(design, data)
        frame = se3(torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(0))).Q, torch.ones(3))
        frame[:3, :3] *= torch.linalg.det(frame[:3, :3]).sign()
        moved = shape.in_frame(frame)
        assert not torch.allclose(moved.points, shape.points)
        posed = moved.posed(data.base @ torch.linalg.inv(frame), data.state)
        torch.testing.assert_close(posed, data.points, rtol=1e-4, atol=1e-5)


def test_where_a_pivot_sits_along_its_axis_changes_no_cloud():
    data = clouds(GLASSES)
    shape = true_shape(GLASSES, data)
    pivot = data.pivot + torch.tensor([[0.3], [-0.2]]) * data.axis
    slid = replace(shape, joints=replace(shape.joints, pivot=pivot))
    torch.testing.assert_close(slid.posed(data.base, data.state), data.points, rtol=1e-4, atol=1e-5)
    centred = slid.with_centred_pivots().joints
    torch.testing.assert_close(centred.pivot, shape.with_centred_pivots().joints.pivot)
    for joint, child in enumerate(centred.chain.child):
        along = (shape.part(child).mean(dim=0) - centred.pivot[joint]) @ centred.axis[joint]
        assert along.abs() < 1e-5


def test_parts_without_joints_stay_where_they_are_put():
    points, label = torch.rand(12, 3), torch.arange(12) % 3
    shape = ArticulatedShape.unjointed(points, label, 3)
    still = torch.eye(4).expand(2, 4, 4)
    torch.testing.assert_close(shape.posed(still, torch.zeros(2, 0)), points.expand(2, 12, 3))
    assert shape.read_states(torch.eye(4).expand(2, 3, 4, 4)).shape == (2, 0)
    assert shape.smallest_share == pytest.approx(1 / 3)
