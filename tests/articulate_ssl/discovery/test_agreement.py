"""Right splits of a collection agree; a wrong one, however well it reconstructs, is thrown out."""

from dataclasses import replace

import pytest
import torch
from articulated_objects import LAPTOP, clouds, true_shape

from articulate_ssl.discovery.agreement import agreeing, agreement, part_labels
from articulate_ssl.discovery.discover import best_by_joints
from articulate_ssl.discovery.options import DiscoveryOptions
from articulate_ssl.discovery.registered_shape import RegisteredShape


@pytest.fixture(scope="module")
def data():
    return clouds(LAPTOP, count=8, points=400, resample=True)


def _registered(data, **changes) -> RegisteredShape:
    shape = replace(true_shape(LAPTOP, data), **changes)
    return RegisteredShape(shape, data.base, data.state, torch.zeros(8, 2, 3), torch.full((8,), 0.02))


def test_points_have_the_part_that_is_nearest(data):
    assert (part_labels(_registered(data), data.points) == data.part).float().mean() > 0.95


def test_names_of_parts_do_not_matter_and_each_cloud_does():
    one = torch.tensor([[0, 0, 1, 1], [0, 1, 1, 2]])
    assert agreement(one, (one + 1) % 3, 3) == 1
    # In one of two clouds the other way round: a renaming is one for all clouds.
    assert agreement(one[:1].repeat(2, 1), torch.stack([one[0], 1 - one[0]]), 2) == 0.5


@pytest.mark.parametrize("place", [0, 3])
def test_a_template_that_takes_half_of_the_clouds_the_other_way_is_thrown_out(data, place):
    right = _registered(data)
    # Lid and base lie the other way round in every second cloud, and the joint is all the more busy.
    pose = right.shape.joints.part_pose(data.base, data.state)
    other = torch.arange(8) % 2 == 1
    base = torch.where(other[:, None, None], pose[:, 1], data.base)
    wrong = replace(right, base=base, state=torch.where(other[:, None], -data.state, data.state), error=right.error / 2)
    halves = (data.rest[:, 1] > data.rest[:, 1].median()).long()  # right and left
    candidates = [right, right, _registered(data, label=halves)]
    candidates.insert(place, wrong)
    kept = agreeing(candidates, data.points)
    assert len(kept) == 2 and all(one is right for one in kept)
    assert best_by_joints(candidates, data.points, DiscoveryOptions(cycles=1)) is wrong  # which is what this is for
    assert agreeing(candidates[:2], data.points) == candidates[:2]
