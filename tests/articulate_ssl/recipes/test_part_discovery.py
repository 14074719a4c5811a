"""Parts and joints of a category are found from its clouds alone."""

import pytest
import torch
from articulated_objects import GLASSES, LAPTOP, clouds

from articulate_ssl.recipes.part_discovery import DiscoveryError, DiscoveryOptions, discover, random_split


def test_the_same_clouds_give_the_same_parts_whatever_the_random_state():
    data = clouds(LAPTOP, count=6, resample=True)
    small = DiscoveryOptions(clouds=6, search_clouds=6, split_clouds=6, points=64, starts=2, rounds=1)
    torch.manual_seed(1)
    first = discover(data.points, 2, LAPTOP[4], small)
    torch.manual_seed(2)
    second = discover(data.points, 2, LAPTOP[4], small)
    assert torch.equal(first.base, second.base) and torch.equal(first.template.label, second.template.label)


def test_three_parts_make_a_tree_of_two_joints():
    data = clouds(GLASSES, count=8, points=96, resample=True)
    small = DiscoveryOptions(clouds=8, search_clouds=8, split_clouds=8, points=96, starts=4, rounds=0)
    found = discover(data.points, 3, GLASSES[4], small)
    chain = found.joints.chain
    assert found.state.shape == (8, 2) and {chain.root, *chain.child} == {0, 1, 2}
    assert found.joints.axis[0] @ found.joints.axis[1] >= 0
    assert set(found.template.label.tolist()) == {0, 1, 2}
    assert found.error.isfinite().all()


def test_impossible_numbers_of_parts_are_refused():
    data = clouds(LAPTOP, count=4)
    small = DiscoveryOptions(clouds=4, search_clouds=4, split_clouds=4, points=48, starts=2, rounds=0, min_share=0.3)
    with pytest.raises(RuntimeError, match="do not show 6 parts"):
        discover(data.points, 6, LAPTOP[4], small)


def test_a_category_that_does_not_move_is_refused():
    copies = clouds(LAPTOP, count=1).points.expand(6, -1, -1).contiguous()
    small = DiscoveryOptions(clouds=6, search_clouds=6, split_clouds=6, points=64, starts=2, rounds=0)
    with pytest.raises(DiscoveryError, match="lost a part in all 2 starts"):
        discover(copies, 2, LAPTOP[4], small)


def test_random_splits_have_k_nonempty_parts():
    generator = torch.Generator().manual_seed(0)
    for parts in (2, 3, 4):
        label = random_split(torch.rand(100, 3), parts, generator)
        assert set(label.tolist()) <= set(range(parts)) and label.bincount(minlength=parts).max() < 90
