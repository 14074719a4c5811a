"""What a registration can be turned into without moving anything in the clouds."""

from dataclasses import replace

import pytest
import torch
from articulated_objects import DRAWER, GLASSES, LAPTOP, clouds, true_shape
from tiny import tiny_module

from articulate_ssl.discovery.instance_fit import InstanceFit
from articulate_ssl.discovery.registered_shape import RegisteredShape
from articulate_ssl.geometry.kinematic_chain import KinematicChain
from articulate_ssl.geometry.screw import REVOLUTE
from articulate_ssl.geometry.se3 import se3
from articulate_ssl.ops.chamfer import nearest_distance


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


def _hung_from_the_second(found: RegisteredShape) -> RegisteredShape:
    """The same two parts as a tree that hangs from the second."""
    joints = replace(found.shape.joints, chain=KinematicChain(2, 1, (1,), (0,)))
    base = found.shape.joints.part_pose(found.base, found.state)[:, 1]
    return replace(found, shape=replace(found.shape, joints=joints), base=base, state=-found.state)


def test_a_category_poses_what_was_found_whichever_part_the_tree_hung_from():
    """A base that is the second part of two was taken for the first: what taught was turned the wrong way."""
    found = _registered(LAPTOP)
    stretch = torch.arange(float(found.log_stretch.numel())).view_as(found.log_stretch)
    part = found.shape.label.expand(len(found.base), -1)
    found = replace(found, log_stretch=stretch, point_part=part)
    hung = _hung_from_the_second(found)
    torch.testing.assert_close(_posed(hung), _posed(found), atol=1e-5, rtol=0)
    named = hung.in_the_trees_order()
    torch.testing.assert_close(_posed(named), _posed(found), atol=1e-5, rtol=0)
    assert torch.equal(named.shape.label, 1 - found.shape.label)
    assert torch.equal(named.log_stretch, stretch[:, [1, 0]]) and torch.equal(named.point_part, 1 - part)

    network = tiny_module(num_parts=2).articulated
    network.category.adopt(named.shape)
    adopted = network.category.articulated_shape(REVOLUTE)
    assert nearest_distance(adopted.posed(named.base, named.state), _posed(found)).max() < 1e-3
    with pytest.raises(ValueError, match="rename its parts"):
        network.category.adopt(hung.shape)


def test_what_is_named_as_trees_are_stays():
    for design in (LAPTOP, GLASSES, DRAWER):
        found = _registered(design)
        named = found.in_the_trees_order()
        assert named.shape.joints.chain == found.shape.joints.chain
        assert torch.equal(named.state, found.state) and torch.equal(named.shape.label, found.shape.label)


def test_joints_come_in_the_trees_order():
    found = _registered(GLASSES)
    joints = found.shape.joints
    assert joints.chain.child == (1, 2)
    chain = KinematicChain(3, 0, (0, 0), (2, 1))
    turned = replace(joints, chain=chain, axis=joints.axis.flip(0), pivot=joints.pivot.flip(0))
    other = replace(found, shape=replace(found.shape, joints=turned), state=found.state.flip(1))
    torch.testing.assert_close(_posed(other), _posed(found))
    named = other.in_the_trees_order()
    assert named.shape.joints.chain == joints.chain
    torch.testing.assert_close(named.state, found.state)
    torch.testing.assert_close(named.shape.joints.pivot, joints.pivot)


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


def test_states_at_an_end_of_what_was_sought_do_not_say_how_far_joints_go():
    found = _registered(GLASSES)
    count = len(found.base)
    state = torch.linspace(-0.5, 0.5, count)[:, None].repeat(1, 2)
    state[0, 1], state[3, 0] = 1.99, -1.0
    found = replace(found, state=state, sought=torch.tensor([[-1.0, 1.0], [-2.0, 2.0]]))
    inside = torch.ones(count, dtype=torch.bool)
    inside[[0, 3]] = False
    assert torch.equal(found.inside, inside)
    assert replace(found, error=torch.arange(float(count)).flip(0)).best(4).tolist() == [5, 4, 2]
    torch.testing.assert_close(found.limits(), replace(found, state=state[inside], sought=None).limits())
    # What is sought next is as wide as all say.
    torch.testing.assert_close(found.limited().joints.limits, replace(found, sought=None).limits())
    assert replace(found, sought=None).inside.all()
    # Most at an end: what was sought was too narrow.
    narrow = replace(found, sought=torch.tensor([[-0.1, 0.1], [-2.0, 2.0]]), state=state.clamp(-0.1, 0.1))
    assert narrow.inside.all()
