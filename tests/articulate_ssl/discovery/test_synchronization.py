"""A collection decides together what its pairs, and its single members, get wrong."""

import pytest
import torch

from articulate_ssl.discovery.synchronization import (
    pairwise_costs,
    standing_margins,
    synchronise,
    total_cost,
    turned_as_the_alike,
    unit_boxes,
)
from articulate_ssl.geometry.rotation_group import rotation_group


def _planted(group, count: int, wrong: float, generator) -> tuple[torch.Tensor, torch.Tensor]:
    """Elements of the clouds, and costs whose cheapest relative element is right for all but a share of the pairs."""
    element = torch.randint(len(group), (count,), generator=generator)
    right = group.product[group.inverse[element]][:, element]  # a_i^{-1} a_j
    noise = torch.randint(len(group), (count, count), generator=generator)
    chosen = torch.where(torch.rand(count, count, generator=generator) < wrong, noise, right)
    costs = 1 + 0.1 * torch.rand(count, count, len(group), generator=generator)
    costs.scatter_(2, chosen[..., None], 0.5)
    return element, costs + costs.transpose(0, 1)[..., group.inverse]


@pytest.mark.parametrize("order", [12, 24])
def test_all_pairs_together_decide_what_two_thirds_of_them_get_wrong(order):
    group, generator = rotation_group(order), torch.Generator().manual_seed(0)
    element, costs = _planted(group, 40, wrong=0.65, generator=generator)
    relative = group.product[group.inverse[element]][:, element]
    pairs = (costs.argmin(dim=-1) == relative).float().mean()
    found = synchronise(costs, group, generator)
    # The same up to one common element: h a_i.
    common = group.product[found, group.inverse[element]]
    assert pairs < 0.7
    assert (common == common.mode().values).all()
    assert total_cost(costs, found, group) == pytest.approx(total_cost(costs, element, group), rel=1e-5)


def test_pairs_that_say_little_do_not_outvote_those_that_say_much():
    group, generator = rotation_group(24), torch.Generator().manual_seed(2)
    element, other = (torch.randint(len(group), (40,), generator=generator) for _ in range(2))
    true, misleading = (group.product[group.inverse[e]][:, e][..., None] for e in (element, other))
    # Seven in ten pairs favour the misleading elements, but barely more than the true ones.
    costs = torch.full((40, 40, len(group)), 1.5).scatter(2, true, 1.0).scatter(2, misleading, 0.95)
    decided = torch.full((40, 40, len(group)), 1.0).scatter(2, true, 0.9)
    says_much = torch.rand(40, 40, generator=generator) < 0.3
    costs = torch.where(says_much[..., None], decided, costs)
    costs = torch.triu(costs.permute(2, 0, 1), 1).permute(1, 2, 0)
    costs = costs + costs.transpose(0, 1)[..., group.inverse]
    assert total_cost(costs, other, group) < total_cost(costs, element, group)
    common = group.product[synchronise(costs, group, generator), group.inverse[element]]
    assert (common == common.mode().values).all()


def test_a_common_element_changes_no_cost():
    group, generator = rotation_group(24), torch.Generator().manual_seed(1)
    element, costs = _planted(group, 10, wrong=0.3, generator=generator)
    turned = group.product[torch.tensor(7), element]
    assert total_cost(costs, turned, group) == pytest.approx(total_cost(costs, element, group), rel=1e-6)


def test_a_turned_cloud_costs_least_under_the_rotation_that_undoes_it():
    group, generator = rotation_group(24), torch.Generator().manual_seed(0)
    shape = torch.rand(600, 3, generator=generator) - 0.5
    shape = shape[(shape.prod(dim=1) > 0) | (shape[:, 0] > 0.2)]  # no symmetry
    elements = torch.tensor([0, 5, 17])
    turned = torch.stack([shape @ group.elements[e].float().T for e in elements])
    boxes, center, width = unit_boxes(3 * turned + 1)
    assert boxes.abs().max() < 0.6
    torch.testing.assert_close(boxes * width[:, None] + center[:, None], 3 * turned + 1)
    costs = pairwise_costs(boxes, group)
    # Cloud j turned by a_i a_j^{-1} is cloud i.
    assert torch.equal(costs.argmin(dim=-1), group.product[elements][:, group.inverse[elements]])
    torch.testing.assert_close(costs, costs.transpose(0, 1)[..., group.inverse])


def test_clouds_that_stand_otherwise_have_the_smallest_margins():
    group, generator = rotation_group(24), torch.Generator().manual_seed(0)
    points = torch.rand(12, 900, 3, generator=generator) - 0.5
    shapes = torch.stack([cloud[(cloud.prod(dim=1) > 0) | (cloud[:, 0] > 0.2)][:400] for cloud in points])
    shapes[3] = shapes[3] @ group.elements[5].float()
    shapes[7] = shapes[7] @ group.elements[17].float()
    margins = standing_margins(unit_boxes(shapes)[0], group)
    assert sorted(margins.argsort()[:2].tolist()) == [3, 7]
    assert margins[[3, 7]].max() < -0.1 and margins.sort().values[2] > -0.05


def _of_two_kinds(generator: torch.Generator) -> torch.Tensor:  # [40, 300, 3]
    """Clouds of two kinds of objects in turn, without symmetries; the corner that the kinds lack is another."""
    points = torch.rand(40, 3000, 3, generator=generator) - 0.5
    lacks = (points > 0).all(dim=-1), (points * torch.tensor([1.0, -1.0, -1.0]) > 0).all(dim=-1)
    return torch.stack(
        [cloud[~lacks[i % 2][i] & (cloud[:, 2] < 0.3 + cloud[:, 0])][:300] for i, cloud in enumerate(points)]
    )


def test_clouds_turn_as_those_most_alike_stand():
    group, generator = rotation_group(24), torch.Generator().manual_seed(0)
    elements = group.elements.float()
    # Of every fifth cloud, another turn is the likeliest; all have four.
    right = torch.where(torch.arange(40) % 5 == 1, 1 + torch.arange(40) % 3, 0)
    offered = torch.stack([torch.randperm(23, generator=generator)[:4] + 1 for _ in right])
    offered[torch.arange(40), right] = group.identity
    pose = elements[torch.randint(24, (40,), generator=generator)]
    clouds = _of_two_kinds(generator) @ pose.mT
    turns = elements[offered] @ pose.mT[:, None]
    assert torch.equal(turned_as_the_alike(turns, clouds), right)


def test_what_stands_already_stays_and_one_cloud_has_nobody_to_ask():
    generator = torch.Generator().manual_seed(1)
    clouds = _of_two_kinds(generator)
    turns = rotation_group(24).elements.float()[:4].expand(40, 4, 3, 3)
    assert not turned_as_the_alike(turns, clouds).any()
    assert turned_as_the_alike(turns[:1], clouds[:1]).tolist() == [0]
