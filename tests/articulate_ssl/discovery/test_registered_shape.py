"""What a registration can be turned into without moving anything in the clouds."""

from dataclasses import replace

import torch
from articulated_objects import DRAWER, GLASSES, LAPTOP, clouds, true_shape

from articulate_ssl.discovery.instance_fit import InstanceFit
from articulate_ssl.discovery.registered_shape import RegisteredShape
from articulate_ssl.geometry.kinematic_chain import KinematicChain
from articulate_ssl.geometry.screw import REVOLUTE
from articulate_ssl.geometry.se3 import se3
from articulate_ssl.shape.articulated_shape import ArticulatedShape
from articulate_ssl.shape.joints import Joints


def _registered(design) -> RegisteredShape:
    data = clouds(design)
    shape, count = true_shape(design, data), len(data.base)
    return RegisteredShape(shape, data.base, data.state, torch.zeros(count, shape.num_parts, 3), torch.zeros(count))


def _posed(found: RegisteredShape) -> torch.Tensor:
    return found.shape.posed(found.base, found.state)


def test_turning_the_canonical_space_moves_nothing():
    found = _registered(LAPTOP)
    turned = found.turned(torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    torch.testing.assert_close(_posed(turned), _posed(found))
    assert not torch.allclose(turned.base, found.base)


def test_where_parts_lie_beside_their_slide_is_kept():
    """Through a registration, some of its clouds, and another canonical space, to the fit that goes on from it."""
    found, generator = _registered(DRAWER), torch.Generator().manual_seed(0)
    start = [0.1 * torch.randn(len(found.base), 2, 3, generator=generator) for _ in range(2)]
    fit = InstanceFit(found.shape, found.base, found.state, generator, torch.eye(3).repeat(2, 1, 1), *start)
    kept = RegisteredShape.of(fit, fit.posed())
    quarter = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    for again in (kept.fit(generator), kept.turned(quarter).fit(generator)):
        torch.testing.assert_close(again.posed(), fit.posed(), atol=1e-5, rtol=0)
    torch.testing.assert_close(kept.of_clouds(slice(2, 5)).fit(generator).posed(), fit.posed()[2:5], atol=1e-5, rtol=0)
    without = RegisteredShape.of(fit, fit.posed())
    assert (replace(without, beside=None).fit(generator).posed() - fit.posed()).norm(dim=-1).mean() > 0.01
    assert RegisteredShape.of(_registered(LAPTOP).fit(generator), fit.posed()).beside is None


def test_a_scaled_shape_is_posed_as_much_larger():
    found = _registered(GLASSES)
    base = se3(found.base[:, :3, :3], 2 * found.base[:, :3, 3])
    torch.testing.assert_close(found.shape.scaled(2.0).posed(base, found.state), 2 * _posed(found))


def test_axes_that_are_parallel_stay():
    found = _registered(GLASSES)
    parallel = found.with_parallel_axes()
    torch.testing.assert_close(_posed(parallel), _posed(found), atol=1e-4, rtol=0)


def test_the_axis_that_most_agree_with_is_taken():
    """Three parallel joints, one of whose axes was found wrong: the other two decide, whichever way they point."""
    found = _registered(GLASSES)
    joints = found.shape.joints
    wrong = torch.nn.functional.normalize(torch.tensor([0.5, 0.6, 0.6]), dim=-1)
    axis = torch.stack([wrong, joints.axis[0], -joints.axis[0]])
    chain = KinematicChain(4, 0, (0, 0, 0), (1, 2, 3))
    label = found.shape.label.clone()
    label[::7] = 3
    lines = Joints(chain, axis, torch.cat([joints.pivot, joints.pivot[:1]]), REVOLUTE)
    state, stretch = torch.zeros(len(found.base), 3), torch.zeros(len(found.base), 4, 3)
    shape = ArticulatedShape(found.shape.points, label, lines)
    fixed = RegisteredShape(shape, found.base, state, stretch, found.error).with_parallel_axes()
    cosine = fixed.shape.joints.axis @ joints.axis[0]
    assert cosine[1:].tolist() == [1.0, -1.0] and abs(abs(float(cosine[0])) - 1) < 1e-6
    torch.testing.assert_close(fixed.state, state)
