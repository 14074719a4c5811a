"""What a registration can be turned into without moving anything in the clouds."""

from dataclasses import replace

import torch
from articulated_objects import DRAWER, GLASSES, LAPTOP, clouds, true_shape

from articulate_ssl.discovery.instance_fit import InstanceFit
from articulate_ssl.discovery.registered_shape import RegisteredShape
from articulate_ssl.geometry.se3 import se3


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
