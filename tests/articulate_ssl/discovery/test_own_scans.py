"""A few scans of an object say where its own hinge is, and which part its points are of."""

from dataclasses import replace

import pytest
import torch
from articulated_objects import OVEN, clouds, true_shape

from articulate_ssl.discovery.options import DiscoveryOptions
from articulate_ssl.discovery.own_scans import by_own_scans
from articulate_ssl.discovery.registered_shape import RegisteredShape
from articulate_ssl.geometry.se3 import transform_points

OFF = torch.tensor([0.0, 0.03, 0.03])  # of the hinge, in an object of other proportions than the category's


@pytest.fixture(scope="module")
def oven():
    data = clouds(OVEN, count=5, points=4096, resample=True)
    shape = true_shape(OVEN, data)
    shape = replace(shape, joints=replace(shape.joints, pivot=shape.joints.pivot + OFF))
    found = RegisteredShape(shape, data.base, data.state, torch.zeros(5, 2, 3), torch.zeros(5))
    return data, found


def _options():
    return DiscoveryOptions(grouped=True, cycles=3)


def _off_the_hinge(found: RegisteredShape, data) -> torch.Tensor:
    """Distance of hinges to those of the objects."""
    joints = found.shape.joints
    hinge = transform_points(found.base, joints.pivot.expand(len(found.base), 1, 3))[:, 0]
    truth = transform_points(data.base[: len(hinge)], data.pivot.expand(len(hinge), 1, 3))[:, 0]
    axis = (data.base[: len(hinge), :3, :3] @ data.axis[0, :, None]).squeeze(-1)
    return torch.linalg.cross(hinge - truth, axis).norm(dim=1)


def test_hinges_and_parts_are_the_objects_own(oven):
    data, found = oven
    wrong = torch.rand(5, 4096, generator=torch.Generator().manual_seed(0)) < 0.1
    truth = data.part.expand(5, -1)
    said = replace(found, point_part=torch.where(wrong, 1 - truth, truth))
    instance = torch.tensor([7, -1, -1, -1, -1])  # of the others it is not known
    scans, of_object = torch.cat([data.points, data.points + 1]), torch.tensor([7] * 5 + [3] * 5)
    own = by_own_scans(said, data.points, instance, scans, of_object, _options())
    before, after = _off_the_hinge(found, data), _off_the_hinge(own, data)
    assert before.min() > 0.02 and after[0] < 0.006
    torch.testing.assert_close(after[1:], before[1:])
    torch.testing.assert_close(own.state[1:], found.state[1:])
    motion = [one.shape.joints.part_pose(one.base, one.state)[0, 1, :3, :3] for one in (own, found)]
    assert torch.trace(motion[0].mT @ motion[1]) > 3 - 0.01  # the door is turned as it was
    assert (own.point_part != truth).double().mean(dim=1)[0] < 0.03
    assert torch.equal(own.point_part[1:], said.point_part[1:])


def test_of_too_few_scans_nothing_is_read(oven):
    data, found = oven
    instance, few = torch.tensor([7, 7, 7, -1, -1]), torch.full((3,), 7)
    own = by_own_scans(found, data.points, instance, data.points[:3], few, _options())
    torch.testing.assert_close(own.base, found.base)  # of each there are two others
    torch.testing.assert_close(own.state, found.state)
