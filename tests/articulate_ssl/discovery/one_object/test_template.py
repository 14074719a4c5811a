"""One object as a category's shape: other conventions, the same object in the same places."""

from dataclasses import replace

import pytest
import roma
import torch
from articulated_objects import DRAWER, GLASSES, OVEN, Clouds, clouds, true_shape

from articulate_ssl.discovery.discover import DiscoveryError
from articulate_ssl.discovery.one_object.find import OneObject
from articulate_ssl.discovery.one_object.template import as_template, resting_at
from articulate_ssl.geometry.kinematic_chain import KinematicChain
from articulate_ssl.geometry.screw import PRISMATIC
from articulate_ssl.shape.articulated_shape import ArticulatedShape
from articulate_ssl.shape.joints import Joints
from articulate_ssl.shape.stretch import principal_directions


def _object(shape: ArticulatedShape, base: torch.Tensor, state: torch.Tensor) -> OneObject:
    joints = replace(shape.joints, axis=shape.joints.axis.double(), pivot=shape.joints.pivot.double())
    shape = replace(shape, points=shape.points.double(), joints=joints)
    label = torch.zeros(len(base), 4, dtype=torch.long)
    share = torch.zeros(len(base), 4, shape.num_parts).double()
    return OneObject(shape, base.double(), state.double(), label, share, torch.full((len(base), 4), 0.003).double())


def _farthest(some: torch.Tensor, others: torch.Tensor) -> float:
    """Of some points [n, M, 3] to the nearest of others [n, N, 3]."""
    return float(torch.cdist(some.double(), others.double()).amin(dim=-1).max())


@pytest.mark.parametrize("design", [OVEN, DRAWER, GLASSES], ids=["oven", "drawer", "glasses"])
def test_another_zero_of_the_states_moves_nothing(design):
    data = clouds(design, count=4, seed=1)
    found = _object(true_shape(design, data), data.base, data.state)
    zero = found.state[0]
    moved = resting_at(found.shape, zero)
    torch.testing.assert_close(
        moved.posed(found.base, found.state - zero), found.shape.posed(found.base, found.state), rtol=0, atol=1e-9
    )
    assert not torch.allclose(moved.points, found.shape.points, atol=0.05)


def test_in_a_chain_joints_move_with_the_parts_they_are_on():
    generator = torch.Generator().manual_seed(0)
    chain = KinematicChain(3, 0, (0, 1), (1, 2))
    axis = torch.nn.functional.normalize(torch.randn(2, 3, generator=generator), dim=-1)
    joints = Joints(chain, axis, torch.randn(2, 3, generator=generator), OVEN[4])
    points = torch.randn(30, 3, generator=generator)
    found = _object(ArticulatedShape(points, torch.arange(30) % 3, joints), torch.eye(4)[None], torch.ones(1, 2))
    zero, state = (torch.randn(2, generator=generator).double() for _ in range(2))
    moved = resting_at(found.shape, zero).posed(found.base, (state - zero)[None])
    torch.testing.assert_close(moved, found.shape.posed(found.base, state[None]))


def test_a_template_follows_the_conventions_of_a_category_and_stays_where_the_object_is():
    data = clouds(OVEN, count=8, points=600, seed=1)
    template = as_template(_object(true_shape(OVEN, data), data.base, data.state), 200)
    shape = template.shape
    assert shape.points.shape == (200, 3) and template.log_stretch.shape == (8, 2, 3)
    assert {value.dtype for value in (shape.points, template.base, template.state)} == {torch.float32}
    torch.testing.assert_close(template.state.mean(dim=0), torch.zeros(1), atol=1e-6, rtol=0)
    torch.testing.assert_close(shape.points.mean(dim=0), torch.zeros(3), atol=1e-6, rtol=0)
    assert (principal_directions(shape.points).abs() - torch.eye(3)).abs().max() < 1e-3
    assert _farthest(shape.posed(template.base, template.state), data.points) < 1e-5
    assert template.axes is None and shape.joints.limits is None
    torch.testing.assert_close(template.error, torch.full((8,), 0.003))


def test_points_are_spread_over_the_object_and_not_over_each_part():
    """A fused object has as many points of a small part as of a large one."""
    data = clouds(OVEN, count=8, points=4000, seed=1)
    shape = true_shape(OVEN, data)
    assert torch.bincount(shape.label).tolist() == [2000, 2000]
    template = as_template(_object(shape, data.base, data.state), 300).shape
    share = torch.bincount(template.label) / 300
    assert 0.6 < share[0] < 0.85  # of the area, the body has .73
    spacing = torch.cdist(template.points, template.points).fill_diagonal_(1).amin(dim=1)
    assert spacing.max() < 2 * spacing.min()


def _framed(data: Clouds) -> torch.Tensor:
    """Rotations that turn clouds into one frame, which stands in any way to the object; but for three of eight."""
    common = roma.euler_to_rotmat("xyz", [90.0, 0.0, 90.0], degrees=True)
    over = torch.eye(3).repeat(len(data.base), 1, 1)
    over[:3] = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    return over @ common @ data.base[:, :3, :3].mT


def test_what_slides_stands_in_the_common_frame_and_slides_along_an_axis_of_it():
    data = clouds(DRAWER, count=8, points=600, seed=1)
    frame = _framed(data)
    shape = true_shape(DRAWER, data)
    tilted = torch.nn.functional.normalize(torch.tensor([[-1.0, 0.02, 0.0]]), dim=-1)  # as well as one is found
    shape = replace(shape, joints=replace(shape.joints, axis=tilted))
    template = as_template(_object(shape, data.base, -data.state), 200, frame)
    assert sorted(template.shape.joints.axis[0].abs().tolist()) == [0, 0, 1]
    torch.testing.assert_close(template.axes, torch.eye(3).expand(2, 3, 3))
    turned = template.base[:, :3, :3]
    assert roma.rotmat_geodesic_distance(turned, torch.eye(3).expand(8, 3, 3)).rad2deg()[3:].max() < 1
    assert _farthest(template.shape.posed(template.base, template.state), data.points @ frame.mT) < 0.01


def test_what_slides_on_what_slides_is_described_on_the_root():
    chain = KinematicChain(3, 0, (0, 1), (1, 2))
    axis = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])  # the second the other way round
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(90, 3, generator=generator)
    shape = ArticulatedShape(points, torch.arange(90) % 3, Joints(chain, axis, torch.zeros(2, 3), PRISMATIC))
    state = torch.rand(5, 2, generator=generator)
    template = as_template(_object(shape, torch.eye(4).repeat(5, 1, 1), state), 90, torch.eye(3).repeat(5, 1, 1))
    assert template.shape.joints.chain.parent == (0, 0)
    assert template.shape.joints.axis[0].tolist() == template.shape.joints.axis[1].tolist()
    before = shape.posed(torch.eye(4).repeat(5, 1, 1), state)
    assert _farthest(template.shape.posed(template.base, template.state), before) < 1e-5


def test_what_slides_askew_is_refused():
    data = clouds(DRAWER, count=8, points=100, seed=1)
    shape = true_shape(DRAWER, data)
    askew = torch.nn.functional.normalize(torch.tensor([[1.0, 0.5, 0.0]]), dim=-1)
    found = _object(replace(shape, joints=replace(shape.joints, axis=askew)), data.base, data.state)
    with pytest.raises(DiscoveryError, match="slide 27 degrees off the axes"):
        as_template(found, 50, _framed(data))
    as_template(found, 50)  # without such a frame there is nothing to be askew to
