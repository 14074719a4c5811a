"""What slides is cut out by how it slides, and found again wherever it is."""

from dataclasses import replace
from itertools import permutations

import pytest
import torch
from articulated_objects import CHEST, OVEN, Clouds, clouds, true_shape

from articulate_ssl.discovery.discover import DiscoveryError
from articulate_ssl.discovery.one_object.adjustment import Placed
from articulate_ssl.discovery.one_object.slide_search import cut_by_slides, slid_anew, slide_alone
from articulate_ssl.discovery.one_object.surface import Surface
from articulate_ssl.discovery.options import DiscoveryOptions
from articulate_ssl.geometry.se3 import se3
from articulate_ssl.shape.articulated_shape import ArticulatedShape


def _world(count: int = 8) -> tuple[Clouds, ArticulatedShape, Placed, list[Surface]]:
    data = clouds(CHEST, count=count, points=2048, resample=True, seed=1)
    shape = true_shape(CHEST, data)
    joints = replace(shape.joints, axis=data.axis.double(), pivot=data.pivot.double())
    surfaces = [Surface.of(cloud) for cloud in data.points.double().numpy()]
    return data, replace(shape, joints=joints), Placed(joints, data.base.double(), data.state.double()), surfaces


def test_parts_are_what_slides_alike():
    data = clouds(CHEST, count=8, points=2048, resample=True, seed=1)
    found = cut_by_slides(data.points, 3, DiscoveryOptions(clouds=8))
    axis = found.base[:, :3, :3] @ found.shape.joints.axis[0]
    assert (axis * (data.base[:, :3, :3] @ data.axis[0])).sum(dim=-1).abs().min() > 0.99
    # Which part is the base is not said by sliding: heights are compared with each other.
    height = torch.zeros(8, 3).scatter(1, torch.tensor([found.shape.joints.chain.child]).expand(8, 2), found.state)
    apart = [height[:, order].diff(dim=1) for order in permutations(range(3))]
    true = torch.cat([torch.zeros(8, 1), data.state], dim=1).diff(dim=1)
    like = [torch.corrcoef(torch.stack([a.flatten(), true.flatten()]))[0, 1].abs() for a in apart]
    assert max(like) > 0.9


def test_what_has_no_common_frame_is_refused():
    ball = torch.nn.functional.normalize(torch.randn(8, 2048, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    with pytest.raises(DiscoveryError, match="no frame in common"):
        cut_by_slides(ball, 2, DiscoveryOptions(clouds=8))


def test_drawers_are_found_where_no_descent_leads():
    _, shape, truth, surfaces = _world()
    wrong = truth.state.clone()
    wrong[2, 0] += 0.12
    wrong[5] -= 0.1
    found = slid_anew(replace(truth, state=wrong), shape, surfaces)
    assert (found.state - truth.state).abs().max() < 0.011  # as far as what is tried is apart
    others = [row for row in range(8) if row not in (2, 5)]
    assert torch.equal(found.state[others], truth.state[others]) and found.state[2, 1] == truth.state[2, 1]


def test_a_chest_that_stands_upside_down_in_one_cloud_does_so_no_more():
    _, shape, truth, surfaces = _world()
    middle = torch.tensor([0.0, 0.3, 0.01]).double()  # of the floor
    turn = torch.diag(torch.tensor([1.0, -1.0, -1.0])).double()
    base, state = truth.base.clone(), truth.state.clone()
    base[3], state[3] = base[3] @ se3(turn, middle - turn @ middle), state[3].flip(0)
    found = slid_anew(replace(truth, base=base, state=state), shape, surfaces)
    torch.testing.assert_close(found.base, truth.base, atol=0.02, rtol=0)
    assert (found.state - truth.state).abs().max() < 0.011
    others = [row for row in range(8) if row != 3]
    assert torch.equal(found.base[others], truth.base[others])


def test_what_is_right_stays_as_it_is():
    _, shape, truth, surfaces = _world(3)
    assert slid_anew(truth, shape, surfaces) is truth


def test_what_turns_does_not_slide():
    _, shape, *_ = _world(3)
    assert slide_alone(shape.joints)
    assert not slide_alone(true_shape(OVEN, clouds(OVEN, count=2)).joints)
    chain = replace(shape.joints.chain, parent=(0, 1))  # one drawer in the other
    assert not slide_alone(replace(shape.joints, chain=chain))
